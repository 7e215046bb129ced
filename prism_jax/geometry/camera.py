"""A pinhole camera in the OpenCV convention, as a pytree."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Float64, Int

from prism_jax.geometry.precision import exact_products

Vector = Sequence[float | int] | Float[Array | np.ndarray, "3"]

MIN_DEPTH = 1e-6
"""Points whose depth is not greater than this count as behind the camera."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """A calibrated pinhole view: ``x = R p + t`` and ``(u, v) = K x / z``.

    Axes are OpenCV's: +x right, +y down, +z forward. Pixel centres lie at integer
    coordinates: a point falls on the pixel ``floor((u, v) + 0.5)``. Lengths are those
    of the points (metres, or half extents of a unit workspace). The arrays are pytree
    leaves, so cameras can be stacked, mapped with ``jax.vmap`` and differentiated; the
    image size is static. Methods take one camera and one cloud.
    """

    # JAX rebuilds pytrees with placeholders for leaves; do not type-check those.
    __no_type_check__ = True

    rotation: Float[Array | np.ndarray, "*batch 3 3"]
    translation: Float[Array | np.ndarray, "*batch 3"]
    intrinsics: Float[Array | np.ndarray, "*batch 3 3"]
    height: int = dataclasses.field(metadata={"static": True})
    width: int = dataclasses.field(metadata={"static": True})

    @property
    @exact_products
    def position(self) -> Float[Array | np.ndarray, "*batch 3"]:
        """The camera centre in the points' frame, ``-R^T t``. Differentiable."""
        return -(self.translation[..., None, :] @ self.rotation)[..., 0, :]

    @exact_products
    def to_camera(
        self, points: Float[Array | np.ndarray, "N 3"]
    ) -> Float[Array | np.ndarray, "N 3"]:
        """Points in the camera's frame. Differentiable."""
        return points @ self.rotation.T + self.translation

    @exact_products
    def project(
        self, points: Float[Array | np.ndarray, "N 3"]
    ) -> tuple[Float[Array, "N 2"], Float[Array, " N"]]:
        """Pixel coordinates ``(u, v)`` and depth ``z`` of points, differentiable.
        Where ``z <= MIN_DEPTH`` the pixel is finite but meaningless."""
        return self._image_of(jnp.asarray(self.to_camera(points)))

    @exact_products
    def pixel_of(
        self, points: Float[Array | np.ndarray, "N 3"]
    ) -> tuple[Int[Array | np.ndarray, " N"], Float[Array | np.ndarray, " N"]]:
        """The pixel that each point falls on, and its depth ``z``.

        Pixels are numbered row by row. A point behind the camera, outside the image
        or not finite gets ``height * width``. NumPy arrays stay NumPy.
        """
        xp: Any = jnp if isinstance(points, jax.Array) else np
        # Projected, they would turn the pose's gradient into NaN, dropped or not.
        finite = xp.isfinite(points).all(axis=-1)
        uv, z = self._image_of(self.to_camera(xp.where(finite[:, None], points, 0.0)))
        xp = jnp if isinstance(uv, jax.Array) else np
        cell = xp.floor(uv + 0.5)
        inside = (cell >= 0) & (cell < xp.array([self.width, self.height]))
        visible = finite & inside.all(axis=-1) & (z > MIN_DEPTH)
        column, row = xp.where(visible[:, None], cell, 0).astype(int).T
        pixel = xp.where(visible, row * self.width + column, self.height * self.width)
        return pixel, z

    @exact_products
    def resized(self, height: int, width: int) -> "Camera":
        """The same view on another pixel grid covering the same field of view."""
        x_scale, y_scale = width / self.width, height / self.height
        scaling = [
            [x_scale, 0.0, 0.5 * x_scale - 0.5],
            [0.0, y_scale, 0.5 * y_scale - 0.5],
            [0.0, 0.0, 1.0],
        ]
        scaling = np.array(scaling, self.intrinsics.dtype)
        return dataclasses.replace(
            self, intrinsics=scaling @ self.intrinsics, height=height, width=width
        )

    def _image_of(self, in_camera: Any) -> tuple[Any, Any]:
        """Pixel coordinates and depth of points in the camera's frame."""
        xp = jnp if isinstance(in_camera, jax.Array) else np
        z = in_camera[:, 2]
        safe_z = xp.where(z > MIN_DEPTH, z, 1.0)
        homogeneous = in_camera @ self.intrinsics.T
        return homogeneous[:, :2] / safe_z[:, None], z

    @classmethod
    @exact_products
    def look_at(
        cls,
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 0.0, 1.0),
        fov_degrees: ArrayLike = 60.0,
        height: int = 128,
        width: int = 128,
    ) -> "Camera":
        """A camera at ``eye`` looking at ``target``, with square pixels.

        ``fov_degrees`` spans the shorter side of the image. Where ``up`` is parallel to
        the line of sight (or zero) a coordinate axis takes its place, and an eye at
        the target looks along +x. Differentiable in eye, target and field of view away
        from these two cases. In the default float: prefer an origin near the scene.
        """
        eye, target, up = (jnp.asarray(x, dtype=float) for x in (eye, target, up))
        sight = target - eye
        coincident = jnp.all(sight == 0)
        forward = jnp.where(coincident, jnp.eye(3)[0], sight)
        forward /= jnp.linalg.norm(forward)
        parallel = jnp.linalg.norm(jnp.cross(forward, up)) <= 1e-4 * jnp.linalg.norm(up)
        least_aligned = jnp.eye(3)[jnp.argmin(jnp.abs(forward))]
        right = jnp.cross(forward, jnp.where(parallel, least_aligned, up))
        right /= jnp.linalg.norm(right)
        rotation = jnp.stack([right, jnp.cross(forward, right), forward])
        focal = 0.5 * min(height, width) / jnp.tan(0.5 * jnp.deg2rad(fov_degrees))
        middle_x, middle_y = 0.5 * (width - 1), 0.5 * (height - 1)
        rows = [focal, 0.0, middle_x], [0.0, focal, middle_y], [0.0, 0.0, 1.0]
        return cls(rotation, -rotation @ eye, jnp.array(rows), height, width)

    @classmethod
    def framing(
        cls,
        points: Float[Array, "N 3"],
        eye: Vector,
        margin: float = 1.3,
        height: int = 128,
        width: int = 128,
    ) -> "Camera":
        """A camera at ``eye`` whose view is filled by the points, with some margin.

        It looks at the centre of their bounding box. Points beside or behind the eye
        widen the view to at most 120 degrees.
        """
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        aimed = cls.look_at(eye, center, height=height, width=width)
        seen = aimed.to_camera(points)
        depth = seen[:, 2]
        sideways = jnp.abs(seen[:, :2]).max(axis=-1)
        widest = jnp.tan(jnp.deg2rad(60.0))
        in_front = depth > MIN_DEPTH
        tangent = sideways / jnp.where(in_front, depth, 1.0)
        tangent = margin * jnp.where(in_front, tangent, widest).max()
        half_angle = jnp.arctan(jnp.clip(tangent, 1e-3, widest))
        fov_degrees = jnp.rad2deg(2 * half_angle)
        return cls.look_at(eye, center, (0.0, 0.0, 1.0), fov_degrees, height, width)


def camera_axes(forward: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows: right, down and forward (x if it is zero) of an OpenCV camera with z up in
    the world."""
    length = np.linalg.norm(forward)
    forward = forward / length if length > 0 else np.array([1.0, 0.0, 0.0])
    up = (0.0, 0.0, 1.0) if abs(forward[2]) < 0.999 else (0.0, 1.0, 0.0)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
