"""Cameras that look at clouds, as `Camera.framing`, in float64 and without JAX."""

import numpy as np
from jaxtyping import Float, Float64

from prism_jax.geometry.camera import MIN_DEPTH, Camera
from prism_jax.geometry.visibility import MAP_MARGIN, MAP_SIZE

WIDEST = np.tan(np.deg2rad(60.0))
"""The tangent that `Camera.framing` reaches to at either side."""


def camera_axes(forward: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows: right, down and forward (x if it is zero) of an OpenCV camera with z up in
    the world."""
    length = np.linalg.norm(forward)
    forward = forward / length if length > 0 else np.array([1.0, 0.0, 0.0])
    up = (0.0, 0.0, 1.0) if abs(forward[2]) < 0.999 else (0.0, 1.0, 0.0)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def framing_camera(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    widest: float = np.inf,
) -> Camera:
    """The camera of a map of `MAP_SIZE` that a cloud fills with `MAP_MARGIN`, at either
    side to the tangent `widest` at most: to that, if points are beside or behind it."""
    axes = camera_axes(0.5 * (points.min(axis=0) + points.max(axis=0)) - eye)
    in_camera = (points - eye) @ axes.T
    tangent = widest
    if (in_camera[:, 2] > MIN_DEPTH).all():
        tangent = MAP_MARGIN * np.abs(in_camera[:, :2] / in_camera[:, 2:]).max()
    tangent = min(max(tangent, 1e-3), widest)
    focal, middle = 0.5 * MAP_SIZE / tangent, 0.5 * (MAP_SIZE - 1)
    intrinsics = np.array([(focal, 0, middle), (0, focal, middle), (0, 0, 1)])
    return Camera(axes, -axes @ eye, intrinsics, MAP_SIZE, MAP_SIZE)
