"""Pictures of the varied cells: is all whole, upright, and where it belongs?"""

from experiments.simulation.contact_sheet import (
    GROUND_TRUTH,
    OBSERVED,
    Row,
    draw_clouds,
)
from experiments.simulation.roboarm.cells import CellsConfig, cell_views
from experiments.simulation.roboarm.pictures import COLORS, beside_camera, draw_parts
from experiments.simulation.view_pictures import draw_map
from prism_jax.data.recordings import DEPTH_SCALE, LABELS
from prism_jax.io.depth import points_from_depth


def workcell_row(split: str, index: int, seed: int, size: int) -> Row:
    """Three square pictures of a cell's first frame, as `build_cells` makes it: the
    cell from beside its camera, without walls; the clouds from there, the measured one
    in blue before the complete one in amber, and people in violet; and the map of what
    the camera knows (`view_pictures.draw_map`)."""
    cell, (view, *_) = cell_views(CellsConfig(split, seed=seed), index)
    beside = beside_camera(view.camera, cell.lower, cell.upper, size)
    people = points_from_depth(
        view.depth * DEPTH_SCALE, view.labels == LABELS["person"], view.camera
    )
    clouds = (
        (view.complete, GROUND_TRUTH),
        (people[::7], COLORS["person"]),
        (view.partial, OBSERVED),
    )
    parts = cell.parts(0)
    del parts["room"]
    pictures = (
        draw_parts(parts, beside),
        draw_clouds(clouds, beside),
        draw_map(view.visibility, size),
    )
    cut = ", cut off" if view.cut else ""
    return Row(f"{cell.arm.model.name}, {cell.mount.kind}{cut}", pictures)
