"""A reference contour: surfaces that stand still, and scans that disagree with them.

Safety scanners refuse to run when a known contour is not where it was: the sensor was
moved, or the layout was changed.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Float64

from prism_jax.envelope.carving import Carving, View, compare
from prism_jax.io.errors import InputError

THIN = 0.02  # metres: of a reference, a cube this wide keeps one point

MOVED, SHOWN = 0.02, 0.5
"""Of a reference that is seen, rays passed through so much at most; and so much of all
of it is seen at least."""


def reference_of(
    scans: Iterable[tuple[View, Float[np.ndarray, "_ 3"]]], carving: Carving = Carving()
) -> Float64[np.ndarray, "R 3"]:
    """What the first scan measured and no ray of another passed through by the carving
    margin, thinned. `scans` are views with the points to keep, in one frame and metres;
    without any point InputError."""
    kept = None
    for view, points in scans:
        if kept is None:
            cubes = np.floor(points / THIN).astype(int)
            rows = np.unique(cubes, axis=0, return_index=True)[1]
            kept = np.asarray(points, np.float64)[np.sort(rows)]
        kept = kept[~compare(view, kept, carving.margin)[1]]
    if kept is None or len(kept) == 0:
        fault = "nothing stands still"
        raise InputError("the reference", fault, "record a cell in which nothing moves")
    return kept


def check_reference(
    view: View, reference: Float[np.ndarray, "R 3"], carving: Carving = Carving()
) -> dict[str, float]:
    """The share of the surfaces that is seen, and of that the one that moved. Raises
    InputError if they are not where they were: see `MOVED` and `SHOWN`. What hides them
    is no fault, as long as enough is seen."""
    on, passed = (some.sum() for some in compare(view, reference, carving.margin))
    seen = float((on + passed) / len(reference))
    moved = float(passed / max(on + passed, 1))
    if seen < SHOWN:
        fault = f"only {seen:.0%} of it is seen, not {SHOWN:.0%}"
        remedy = "uncover the view, check the camera's pose, or make it again"
        raise InputError("the reference", fault, remedy)
    if moved > MOVED:
        fault = f"{moved:.1%} of what is seen of it has moved or is gone"
        remedy = "check the camera's pose; of another layout make a new reference"
        raise InputError("the reference", fault, remedy)
    return {"share_seen": seen, "share_moved": moved}
