"""The frame in which a completer works, and the unit in which it is scored."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float32

from prism_jax.data.ordering import first_points
from prism_jax.data.source import Example
from prism_jax.evaluation import metrics
from prism_jax.geometry.visibility import Background
from prism_jax.geometry.workspace import Workspace
from prism_jax.preprocessing import observation

NORMALISATIONS = ("partial", "oracle", "own")

UNITS = {"complete": metrics.UNIT, "own": "the data set's own unit"}
"""What scores can be in, and in words."""


@dataclasses.dataclass(frozen=True)
class Protocol:
    """What a completer is given, and how its output is scored."""

    num_partial: int  # points of the partial cloud, in farthest-point order
    margin: float  # side of the workspace over the longest side of the box in it
    # What places the workspace: the box of the ``partial``, or (``oracle``) of the
    # complete cloud, as in the paper; ``own``: the data set's coordinates are its.
    normalisation: str = "partial"
    # Of the scores, one of `UNITS`; ``own`` is that of the set's published tables.
    unit: str = "complete"
    # Whether the earth mover's distance is taken, which costs the most.
    with_emd: bool = True
    # Whether the partial and the predictions with the measured points are scored, too.
    with_measured: bool = True
    # Which one the completer knows objects in; the partial decides on it.
    heading: observation.Heading = "given"
    # Whether what lies around a partial is empty, and no point is added there.
    background: Background = "unknown"
    # Whether the examples' visibility maps are given to the completer and the filter.
    uses_visibility: bool = False

    def __post_init__(self):
        if self.normalisation not in NORMALISATIONS:
            raise ValueError(f"normalisation must be one of {NORMALISATIONS}")
        if self.unit not in UNITS:
            raise ValueError(f"unit must be one of {tuple(UNITS)}")


def workspace_for(example: Example, protocol: Protocol) -> Workspace:
    """Where the completer works, in the frame of the example."""
    if protocol.normalisation == "own":
        return Workspace.unit()
    margin = protocol.margin
    assert example.partial is not None
    workspace = observation.workspace_around(
        example.partial, example.eye, margin, heading=protocol.heading
    )
    if protocol.normalisation == "partial":
        return workspace
    assert example.complete is not None
    return Workspace.from_points(example.complete, margin, workspace.rotation)


def into_scored(
    example: Example, protocol: Protocol
) -> tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]:
    """Two functions into the frame of the scores: of clouds in the example's own frame,
    and of clouds in the workspace."""
    workspace, frame = workspace_for(example, protocol), Workspace.unit()
    if protocol.unit == "complete":
        assert example.complete is not None
        frame = Workspace.from_points(example.complete, 1.0)

    def from_own(cloud: np.ndarray) -> np.ndarray:
        return np.asarray(frame.to_unit(cloud.astype(np.float64)))

    def from_workspace(cloud: np.ndarray) -> np.ndarray:
        return from_own(np.asarray(workspace.from_unit(cloud.astype(np.float64))))

    return from_own, from_workspace


def observed(example: Example, protocol: Protocol) -> observation.Observation:
    """What the completer gets of an example. The points are sampled first, in the order
    that the example's source decides."""
    assert example.partial is not None
    few = first_points(example.partial, protocol.num_partial, example.ordered)
    return observation.observe(few, example.eye, workspace_for(example, protocol))


def side_by_side(
    observations: Sequence[observation.Observation],
) -> tuple[Float32[np.ndarray, "B N 3"], Float32[np.ndarray, "B 3"]]:
    """The partials and the sensors' places of several, as a completer takes them."""
    partials = np.stack([seen.partial for seen in observations])
    eyes = np.stack([seen.eye for seen in observations])
    return partials.astype(np.float32), eyes.astype(np.float32)
