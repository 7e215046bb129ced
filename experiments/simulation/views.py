"""One mesh: its complete cloud and partial views of it.

The bounding box of the complete cloud is centred at the origin and its longest side
spans [-1, 1]. A network never sees this frame. Coordinates are multiples of `QUANTUM`,
which 16 bits hold up to +-2, and float32 exactly.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Float32

from experiments.simulation.kinds import View, draw_kind, make_view
from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.shapes import category_rng, make_shape
from prism_jax.data.ordering import farthest_point_order
from prism_jax.data.source import Example
from prism_jax.geometry.visibility import Visibility

QUANTUM = 2.0**-14
# What shards store in this box is exactly what was made.
BOX = np.array([-2.0, -2.0, -2.0, QUANTUM], np.float32)
SURFACE_POINTS = 16384
PARTIAL_POINTS = 2048
# What manifests say of the clouds.
STORED = {
    "partial_points": PARTIAL_POINTS,
    "complete_points": SURFACE_POINTS,
    "quantum": QUANTUM,
}
MIN_RETURNS = 16  # a view of fewer points is drawn again
MAX_DRAWS = 100


class Views(NamedTuple):
    """Partial clouds, the complete cloud, viewpoints, kinds as in `kinds.KINDS` without
    "mixed", and what each sensor knows, if it is said."""

    partials: Float32[np.ndarray, "V 2048 3"]
    complete: Float32[np.ndarray, "16384 3"]
    eyes: Float32[np.ndarray, "V 3"]
    kinds: tuple[str, ...]
    visibilities: tuple[Visibility | None, ...]


def rounded(points: Float[np.ndarray, "*shape 3"]) -> Float32[np.ndarray, "*shape 3"]:
    """Nearest multiples of `QUANTUM`; coordinates beyond +-1.99 raise ValueError."""
    if not np.all(np.abs(points) < 1.99):
        raise ValueError("coordinates must be finite and within +-1.99")
    steps = np.round(points / QUANTUM).astype(np.int16)
    return steps.astype(np.float32) * np.float32(QUANTUM)


def make_views(
    category: str, seed: int, num_views: int = 1, partial: str = "self_occlusion"
) -> Views:
    """`views_of` a procedural shape: a pure function of its arguments."""
    rng = category_rng(category, seed, 1)
    return views_of(make_shape(category, seed), rng, num_views, partial)


def views_of(
    mesh: trimesh.Trimesh,
    rng: np.random.Generator,
    num_views: int = 1,
    partial: str = "self_occlusion",
    two_sided: bool = False,
) -> Views:
    """Views of a mesh, of one of `kinds.KINDS`.

    The complete cloud is of what can be seen from outside (`sample_outside`). All
    clouds are in farthest-point order; a partial of fewer distinct points than 2,048 is
    repeated from its start. More views begin with the same ones. The viewpoint of a
    crop is NaN. A mesh of which almost nothing is seen, or that gives no view, raises
    ValueError.
    """
    surface = sample_outside(Scene(mesh), SURFACE_POINTS, rng, two_sided)
    lower, upper = surface.min(axis=0), surface.max(axis=0)
    center, half = (lower + upper) / 2, (upper - lower).max() / 2
    vertices = (mesh.vertices - center) / half
    complete = farthest_point_order((surface - center) / half, SURFACE_POINTS)
    scene = Scene(trimesh.Trimesh(vertices, mesh.faces, process=False))
    views = [_view(partial, scene, complete, rng) for _ in range(num_views)]
    return Views(
        np.stack([rounded(view.points) for view in views]),
        rounded(complete),
        np.stack([view.eye.astype(np.float32) for view in views]),
        tuple(view.kind for view in views),
        tuple(view.visibility for view in views),
    )


def examples(made: Views, category: str, name: str) -> Iterator[Example]:
    """Views as a source has them, view after view: `name` tells the mesh, and what has
    a map also says of what kind it is."""
    for view, known in enumerate(made.visibilities):
        kind = "" if known is None else f"/{made.kinds[view]}"
        yield Example(
            made.complete,
            made.partials[view],
            made.eyes[view],
            category,
            f"{name}/{view:02d}{kind}",
            ordered=True,
            visibility=known,
        )


def _view(
    kind: str, scene: Scene, complete: np.ndarray, rng: np.random.Generator
) -> View:
    if kind == "mixed":
        # Once, or kinds that are often drawn again would become rare.
        kind = draw_kind(rng)
    for _ in range(MAX_DRAWS):
        view = make_view(kind, scene, complete, rng, PARTIAL_POINTS)
        if len(view.points) >= MIN_RETURNS:
            ordered = farthest_point_order(view.points, PARTIAL_POINTS)
            eye = np.full(3, np.nan) if kind == "crop" else view.eye
            return view._replace(points=ordered, eye=eye)
    raise ValueError(f"no {kind} view of {MIN_RETURNS} points in {MAX_DRAWS} draws")
