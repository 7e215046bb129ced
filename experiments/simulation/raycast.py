"""First hits of rays on a triangle mesh, and what of a surface is seen from outside.

Embree searches in float32 and finds triangle and barycentric coordinates; the points
are made of these and of the mesh's own float64 corners.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float64, Int

from prism_jax.geometry.cloud import sphere

NUM_VIEWPOINTS = 96
VIEWPOINT_DISTANCE = 3.0  # from the centre, in radii of the bounding sphere
CRACK = 1e-4
"""Radii of the bounding sphere by which a point is lifted off its surface before it
looks for a viewpoint. Walls that are closer together than this hide each other."""
FAR_FROM_ORIGIN = 8.0
"""A mesh whose centre is more radii away than this is moved to the origin for Embree,
for the sake of float32."""
MIN_SEEN = 1e-3
MOST_DRAWN = 2**17  # points at once: memory, where little is seen


class Hits(NamedTuple):
    """The rays that hit, in ray order: what they hit, where, how far, how steeply."""

    ray: Int[np.ndarray, " H"]
    points: Float64[np.ndarray, "H 3"]
    faces: Int[np.ndarray, " H"]
    distances: Float64[np.ndarray, " H"]
    cosines: Float64[np.ndarray, " H"]


class Scene:
    """A mesh to cast rays at, seen from both sides. It must not change afterwards.

    Without triangles, or with corners that are not finite, it raises ValueError.
    """

    def __init__(self, mesh: trimesh.Trimesh):
        self.mesh = mesh
        self.triangles = np.array(mesh.triangles, np.float64)
        if len(self.triangles) == 0 or not np.isfinite(self.triangles).all():
            raise ValueError("a scene needs triangles with finite corners")
        corners = self.triangles.reshape(-1, 3)
        lower, upper = corners.min(axis=0), corners.max(axis=0)
        self.center = (lower + upper) / 2
        self.radius = float(np.linalg.norm(upper - lower) / 2)
        far = np.linalg.norm(self.center) > FAR_FROM_ORIGIN * self.radius
        self._shift = self.center if far else np.zeros(3)
        self._embree = EmbreeScene(robust=True)
        TriangleMesh(self._embree, (self.triangles - self._shift).astype(np.float32))
        edges = self.triangles[:, 1:] - self.triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals / np.where(length > 0, length, 1.0)
        self.areas = length[:, 0] / 2

    def cast(
        self,
        origins: Float[np.ndarray, "3"] | Float[np.ndarray, "R 3"],
        directions: Float[np.ndarray, "R 3"],
    ) -> Hits:
        """The first triangle along each ray, from one common origin or one a ray.

        Directions need no unit length; distances are Euclidean all the same. Cosines
        are without sign. What is not finite raises ValueError; a zero direction hits
        nothing.
        """
        if not (np.isfinite(origins).all() and np.isfinite(directions).all()):
            raise ValueError("rays must be finite")
        starts = np.broadcast_to(_single(origins - self._shift), directions.shape)
        result = self._embree.run(_single(starts), _single(directions), output=True)
        ray = np.flatnonzero(result["primID"] >= 0)
        faces = result["primID"][ray]
        u, v = (result[name][ray, None].astype(np.float64) for name in ("u", "v"))
        points = self._on_faces(faces, u, v)
        start = origins[ray] if origins.ndim == 2 else origins
        along = directions[ray]
        cosines = np.abs(_dot(along, self.normals[faces])) / np.sqrt(_dot(along, along))
        distances = np.sqrt(_dot(points - start, points - start))
        return Hits(ray, points, faces, distances, np.minimum(cosines, 1.0))

    def seen_from_outside(
        self,
        points: Float[np.ndarray, "N 3"],
        normals: Float[np.ndarray, "N 3"],
        two_sided: bool = False,
    ) -> Bool[np.ndarray, " N"]:
        """Whether a straight line leads from each surface point to a viewpoint.

        `normals` point away from the solid; where they may point to either side,
        `two_sided` counts a point as seen if it is on one of the two. A point is lifted
        by `CRACK` along its normal and seen if nothing stands between it and one of
        `NUM_VIEWPOINTS` points spread around the mesh. So the walls of a narrower crack
        are not seen, nor the inside of a closed hollow body; what shows itself to less
        than about 1 / `NUM_VIEWPOINTS` of all directions, deep in a slit, may count as
        unseen.
        """
        seen = self._seen_along(points, normals)
        if two_sided:
            rest = np.flatnonzero(~seen)
            seen[rest] = self._seen_along(points[rest], -normals[rest])
        return seen

    def _seen_along(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Of the side that normals point to."""
        around = VIEWPOINT_DISTANCE * self.radius * VIEWPOINT_DIRECTIONS
        eyes = _single(self.center + around - self._shift)
        lifted = _single(points + CRACK * self.radius * normals - self._shift)
        order = _ORDER[np.argmax(normals @ VIEWPOINT_DIRECTIONS.T, axis=1)]
        hidden = np.arange(len(points))
        for column in range(NUM_VIEWPOINTS):
            if len(hidden) == 0:
                break
            start = lifted[hidden]
            toward = eyes[order[hidden, column]] - start
            hidden = hidden[self._embree.run(start, toward, query="OCCLUDED") >= 0]
        seen = np.ones(len(points), bool)
        seen[hidden] = False
        return seen

    def _on_faces(self, faces: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Points of faces by the barycentric coordinates of their last two corners."""
        first, second, third = (self.triangles[:, i][faces] for i in range(3))
        return (1 - u - v) * first + u * second + v * third


def sample_outside(
    scene: Scene,
    num_points: int,
    rng: np.random.Generator,
    two_sided: bool = False,
    wanted: Bool[np.ndarray, " F"] | None = None,
) -> Float64[np.ndarray, "num_points 3"]:
    """Points uniform on the area of the mesh that is seen from outside.

    `two_sided` as in `Scene.seen_from_outside`. Where some faces are `wanted`, the
    others only stand in the way. A surface of which less than `MIN_SEEN` is seen raises
    ValueError.
    """
    cumulative = np.cumsum(scene.areas if wanted is None else scene.areas * wanted)
    kept, missing = [], num_points
    drawn, seen_of_drawn = 0, 0
    while missing > 0:
        draw = int(missing * max(drawn, 1) / max(seen_of_drawn, 1)) + 1
        draw = min(draw, MOST_DRAWN)
        faces = np.searchsorted(cumulative, rng.random(draw) * cumulative[-1], "right")
        faces = np.minimum(faces, len(cumulative) - 1)
        u, v = rng.random((2, draw, 1))
        folded = u + v > 1
        u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
        points = scene._on_faces(faces, u, v)
        seen = scene.seen_from_outside(points, scene.normals[faces], two_sided)
        drawn, seen_of_drawn = drawn + draw, seen_of_drawn + int(seen.sum())
        if seen_of_drawn < MIN_SEEN * drawn:
            raise ValueError("almost nothing of the surface is seen from outside")
        kept.append(points[seen][:missing])
        missing -= len(kept[-1])
    return np.concatenate(kept)


def _single(vectors: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(vectors, np.float32)


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", first, second)


def direction(
    azimuth: float | np.ndarray, elevation: float | np.ndarray
) -> Float64[np.ndarray, "*shape 3"]:
    """Unit vectors by their angles in radians, z up."""
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1)


VIEWPOINT_DIRECTIONS = sphere(NUM_VIEWPOINTS)
_ORDER = np.argsort(
    -(VIEWPOINT_DIRECTIONS @ VIEWPOINT_DIRECTIONS.T), axis=1, kind="stable"
)
"""Row i: all viewpoints, those nearest in direction to viewpoint i first."""
