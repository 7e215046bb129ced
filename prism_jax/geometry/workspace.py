"""The cube a network works in: metres in a sensor frame to [-1, 1]^3 and back."""

import dataclasses
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.precision import exact_products

CUBE_MARGIN = 1.4  # side of a cube around points over the longest side of their box


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True)
class Workspace:
    """A cube in the user's frame, in metres: its centre, half side and axes.

    `rotation` takes the frame's axes to the cube's, whose z points up; None means the
    frame's own axes. A pytree; every method is differentiable and keeps NumPy arrays
    NumPy, so that double precision survives far from the origin. A centre that is not
    finite, or a half side not finite and positive, raises ValueError outside ``jit``.
    """

    # Pytrees are rebuilt with other leaves than arrays; do not type-check those.
    __no_type_check__ = True

    center: Float[Array | np.ndarray, "*batch 3"]
    half_extent: Float[Array | np.ndarray, "*batch"]
    rotation: Float[Array | np.ndarray, "*batch 3 3"] | None = None

    def __post_init__(self):
        half_extent, center = _known(self.half_extent), _known(self.center)
        if not (np.isfinite(half_extent) & (half_extent > 0)).all():
            fault = f"half_extent must be positive and finite, not {half_extent}"
            raise ValueError(f"a workspace's {fault}")
        if not np.isfinite(center).all():
            raise ValueError(f"a workspace's center must be finite, not {center}")

    def tree_flatten_with_keys(self):
        """The fields with their names, for JAX."""
        key = jax.tree_util.GetAttrKey
        return [(key(name), leaf) for name, leaf in vars(self).items()], None

    @classmethod
    def tree_unflatten(cls, _: None, leaves: Any) -> "Workspace":
        """Without a check: a gradient has the same structure and may be negative."""
        self = object.__new__(cls)
        names = (field.name for field in dataclasses.fields(cls))
        vars(self).update(zip(names, leaves, strict=True))
        return self

    @classmethod
    def unit(cls) -> "Workspace":
        """[-1, 1]^3 itself, for points that are already in workspace units."""
        return cls(np.zeros(3), np.ones(()))

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """The cube's z axis in the user's frame, in double precision. Of one cube."""
        vertical = np.array([0.0, 0.0, 1.0])
        return vertical if self.rotation is None else np.asarray(self.rotation)[2]

    @exact_products
    def to_unit(
        self, points: Float[Array | np.ndarray, "*points 3"]
    ) -> Float[Array | np.ndarray, "*points 3"]:
        """Metres to workspace units. Points outside the cube land outside [-1, 1]."""
        unit = (points - self.center) / self.half_extent
        return unit if self.rotation is None else unit @ self.rotation.T

    @exact_products
    def from_unit(
        self, points: Float[Array | np.ndarray, "*points 3"]
    ) -> Float[Array | np.ndarray, "*points 3"]:
        """Workspace units to metres, the inverse of ``to_unit``."""
        unit = points if self.rotation is None else points @ self.rotation
        return unit * self.half_extent + self.center

    @exact_products
    def camera_to_unit(self, camera: Camera) -> Camera:
        """The same view for points in workspace units: same pixels, depth / half side.
        With ``p = c + h S^T q``: ``(R p + t) / h = R S^T q + (R c + t) / h``."""
        turned, translation = camera.rotation, camera.translation
        translation = (turned @ self.center + translation) / self.half_extent
        turned = turned if self.rotation is None else turned @ self.rotation.T
        return dataclasses.replace(camera, rotation=turned, translation=translation)

    @exact_products
    def camera_from_unit(self, camera: Camera) -> Camera:
        """The same view for points in metres, the inverse of ``camera_to_unit``."""
        turned = camera.rotation
        turned = turned if self.rotation is None else turned @ self.rotation
        translation = camera.translation * self.half_extent - turned @ self.center
        return dataclasses.replace(camera, rotation=turned, translation=translation)

    @classmethod
    @exact_products
    def from_points(
        cls,
        points: Float[Array | np.ndarray, "N 3"],
        margin: float = CUBE_MARGIN,
        rotation: Float[Array | np.ndarray, "3 3"] | None = None,
        where: Bool[Array | np.ndarray, " N"] | None = None,
    ) -> "Workspace":
        """The cube around a cloud: centre of its bounding box, longest side x margin.

        Pass the partial cloud, never the ground truth. With `rotation` the box has the
        cube's axes. Only points marked by `where` count; at least one is needed. One
        point gets a half side of 1. None, or points that are not finite, raise
        ValueError.
        """
        if points.shape[0] == 0:
            raise ValueError("a workspace cannot be taken from an empty cloud")
        along = points if rotation is None else points @ rotation.T
        xp = jnp if isinstance(along, jax.Array) else np
        along = xp.asarray(along, float)
        counted = True if where is None else where[:, None]
        lower = along.min(axis=0, where=counted, initial=np.inf)
        upper = along.max(axis=0, where=counted, initial=-np.inf)
        half_extent = 0.5 * margin * (upper - lower).max(axis=-1)
        half_extent = xp.where(half_extent > 0, half_extent, 1.0)
        center = 0.5 * (lower + upper)
        center = center if rotation is None else center @ rotation
        return cls(center, half_extent, rotation)


def _known(numbers: Any) -> np.ndarray:
    """The numbers, or one that is always right where they are traced."""
    return np.ones(()) if isinstance(numbers, jax.core.Tracer) else np.asarray(numbers)
