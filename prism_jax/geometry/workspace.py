"""The cube a network works in: metres in a sensor frame to [-1, 1]^3 and back."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.precision import exact_products


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["center", "half_extent"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True)
class Workspace:
    """An axis-aligned cube in the sensor's frame: centre and half side, in metres.

    A pytree; every method is differentiable and uses only operators, so NumPy arrays
    stay NumPy: double precision survives for a cloud far from its frame's origin.
    """

    # JAX rebuilds pytrees with placeholders for leaves; do not type-check those.
    __no_type_check__ = True

    center: Float[Array | np.ndarray, "*batch 3"]
    half_extent: Float[Array | np.ndarray, "*batch"]

    def to_unit(
        self, points: Float[Array | np.ndarray, "*points 3"]
    ) -> Float[Array | np.ndarray, "*points 3"]:
        """Metres to workspace units. Points outside the cube land outside [-1, 1]."""
        return (points - self.center) / self.half_extent

    def from_unit(
        self, points: Float[Array | np.ndarray, "*points 3"]
    ) -> Float[Array | np.ndarray, "*points 3"]:
        """Workspace units to metres, the inverse of ``to_unit``."""
        return points * self.half_extent + self.center

    @exact_products
    def camera_to_unit(self, camera: Camera) -> Camera:
        """The same view for points in workspace units: same pixels, depth / half side.

        With ``p = c + h q``: ``(R p + t) / h = R q + (R c + t) / h``.
        """
        translation = camera.rotation @ self.center + camera.translation
        return dataclasses.replace(camera, translation=translation / self.half_extent)

    @classmethod
    def from_points(
        cls, points: Float[Array | np.ndarray, "N 3"], margin: float = 1.25
    ) -> "Workspace":
        """The cube around a cloud: centre of its bounding box, longest side x margin.

        Pass the partial cloud, never the ground truth. A cloud without extent (one
        point) gets a half side of 1; an empty one raises a ValueError. Non-finite
        points give a non-finite workspace: drop them first.
        """
        if points.shape[0] == 0:
            raise ValueError("a workspace cannot be taken from an empty cloud")
        return cls.from_bounds(points.min(axis=0), points.max(axis=0), margin)

    @classmethod
    def from_bounds(cls, lower, upper, margin: float = 1.0) -> "Workspace":
        """The smallest cube, times a margin, around an axis-aligned box (metres).

        Bounds without extent give a half side of 1.
        """
        xp = jnp if isinstance(lower, jax.Array) else np
        lower, upper = xp.asarray(lower, float), xp.asarray(upper, float)
        half_extent = 0.5 * margin * (upper - lower).max(axis=-1)
        half_extent = xp.where(half_extent > 0, half_extent, 1.0)
        return cls(center=0.5 * (lower + upper), half_extent=half_extent)
