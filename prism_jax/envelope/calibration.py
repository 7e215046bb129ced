"""A margin whose coverage was measured: split conformal prediction over cells.

The score of a cell is the largest distance of a point of its true surface from what is
measured, predicted, the robot's or a known part's (`Surfaces.needed`). The margin q is
the ceil((n + 1)(1 - alpha))-th smallest of n scores. Of another cell that is drawn like
these, the inflated surfaces hold all of the true surface with a probability of at least
1 - alpha, over cells and calibrations (Vovk, Gammerman & Shafer 2005, "Algorithmic
Learning in a Random World"; Papadopoulos et al. 2002, "Inductive confidence machines
for regression"). Frames of one cell resemble each other and count once. Of other cells
than these nothing is promised.
"""

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.envelope import NOTICE
from prism_jax.envelope.distance import Surfaces
from prism_jax.io import atomic
from prism_jax.io.errors import InputError
from prism_jax.io.files import parsing, read_json

FORMAT = "prism_jax envelope calibration, version 2"
_AGAIN = "calibrate again, with the flags of this run"
_ROUNDING = 1e-9

OUT_OF_SCALE = 10.0
"""Scans that are so many times larger or smaller than the calibrated ones are refused:
millimetres, centimetres and inches, but not feet."""


def cell_score(truth: Float[np.ndarray, "N 3"], surfaces: Surfaces) -> float:
    """The smallest margin at which inflated surfaces hold every point of the truth.

    In the points' unit. Infinite without any surface; an empty truth raises InputError.
    """
    if len(truth) == 0:
        raise InputError("truth", "no points", "give the true surface of the cell")
    return float(surfaces.needed(np.asarray(truth, np.float64)).max())


def cells_needed(alpha: float) -> int:
    """The least number of cells that a margin can be told from. An alpha that is no
    share that cells can tell raises InputError."""
    if not 1e-9 < alpha < 1.0:
        fault = f"{alpha:g} is not between 1e-9 and 1"
        raise InputError("alpha", fault, "give a share of cells, such as 0.1")
    return math.ceil((1.0 - alpha) / alpha - _ROUNDING)


def conformal_margin(scores: Sequence[float], alpha: float) -> float:
    """The ceil((n + 1)(1 - alpha))-th smallest of n scores.

    Fewer scores than `cells_needed`, and scores of which that one is not finite, raise
    InputError.
    """
    needed = cells_needed(alpha)
    if len(scores) < needed:
        fault = f"{len(scores)} cells are too few for alpha {alpha:g}"
        remedy = f"calibrate on {needed} or more, or use a larger alpha"
        raise InputError("calibration", fault, remedy)
    rank = math.ceil((len(scores) + 1) * (1.0 - alpha) - _ROUNDING)
    margin = float(np.sort(np.asarray(scores, np.float64))[max(rank, 1) - 1])
    if not math.isfinite(margin):
        fault = f"no finite margin for alpha {alpha:g}: too many cells without surface"
        raise InputError("calibration", fault, "omit them, or move the sensor")
    return margin


@dataclasses.dataclass(frozen=True)
class Setup:
    """What a margin holds for: anything else needs a calibration of its own."""

    weights: str  # sha256 of the file of weights
    sensor: str  # what the sensor is called
    settings: Mapping[str, Any]  # how scans are completed, as JSON has it


@dataclasses.dataclass(frozen=True)
class MarginCalibration:
    """Scores of cells, and what they were made with."""

    setup: Setup  # what runs
    alpha: float  # the share of cells that may be missed, unless another is asked for
    cells: tuple[str, ...]  # names of the cells
    digests: tuple[str, ...]  # what tells the recording of one cell from another's
    scores: tuple[float, ...]  # of each cell, in metres
    # The least and the largest diagonal of the scans, in metres.
    extent: tuple[float, float]

    def __post_init__(self):
        for names, told in ((self.cells, "names"), (self.digests, "recordings")):
            if len(set(names)) != len(names):
                fault = f"two cells have the same {told}"
                raise InputError("calibration", fault, "use each cell once")
            if len(names) != len(self.scores):
                fault = f"{len(self.scores)} scores, {len(names)} {told} of cells"
                raise InputError("calibration", fault, _AGAIN)
        if not all(score >= 0 for score in self.scores):
            raise InputError("calibration", "negative score", _AGAIN)
        if not 0 < self.extent[0] <= self.extent[1] < math.inf:
            raise InputError("calibration", f"extent {self.extent}", _AGAIN)
        self.margin()

    def margin(self, alpha: float | None = None) -> float:
        """The q for `alpha`, by default the calibration's own. One that there are too
        few cells for raises InputError."""
        return conformal_margin(self.scores, self.alpha if alpha is None else alpha)

    def check_units(self, points: Float[np.ndarray, "N 3"]) -> None:
        """Raises InputError if a scan is `OUT_OF_SCALE` times larger or smaller than
        all that this was calibrated on: it is hardly in metres."""
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        least, most = self.extent
        if not least / OUT_OF_SCALE <= size <= most * OUT_OF_SCALE:
            fault = f"extends {size:.4g}, calibrated on scans of {least:.3g} to "
            fault += f"{most:.3g} m"
            raise InputError("the scan", fault, "give metres, and the calibrated part")

    def to_dict(self) -> dict[str, Any]:
        """As the file has it."""
        return {
            "format": FORMAT,
            "notice": NOTICE,
            "weights_sha256": self.setup.weights,
            "sensor": self.setup.sensor,
            "settings": dict(self.setup.settings),
            "unit": "m",
            "extent": list(self.extent),
            "n": len(self.cells),
            "alpha": self.alpha,
            "q": self.margin(),
            "cells": list(self.cells),
            "digests": list(self.digests),
            # Strict JSON has no infinity: of a cell without any surface it is null.
            "scores": [one if math.isfinite(one) else None for one in self.scores],
        }

    def write(self, path: str | os.PathLike) -> None:
        """Writes the file, whole or not at all."""
        text = json.dumps(self.to_dict(), indent=1, allow_nan=False)
        atomic.write_bytes(path, (text + "\n").encode())


def read_calibration(path: str | os.PathLike) -> MarginCalibration:
    """The calibration of a file. One that is none, and one whose numbers contradict
    each other, raise InputError."""
    content = read_json(path, _AGAIN)
    with parsing(path, "a valid calibration", _AGAIN, Exception):
        if content.get("format") != FORMAT:
            raise ValueError(f"format is not {FORMAT!r}")
        least, most = map(float, content["extent"])
        weights, sensor = str(content["weights_sha256"]), str(content["sensor"])
        scores = [math.inf if one is None else float(one) for one in content["scores"]]
        calibration = MarginCalibration(
            setup=Setup(weights, sensor, {**content["settings"]}),
            alpha=float(content["alpha"]),
            cells=tuple(map(str, content["cells"])),
            digests=tuple(map(str, content["digests"])),
            scores=tuple(scores),
            extent=(least, most),
        )
        if content["n"] != len(calibration.cells):
            raise ValueError(f"n = {content['n']} is not the number of cells")
        told, own = float(content["q"]), calibration.margin()
        if not math.isclose(told, own, rel_tol=1e-9):
            raise ValueError(f"q is {own:g} by its scores, not {told:g}")
        return calibration


def check_setup(
    calibration: MarginCalibration, runs: Setup, path: str | os.PathLike
) -> None:
    """Raises InputError about `path` if it was calibrated for anything else."""
    made, told = calibration.setup, []
    if made.weights != runs.weights:
        told.append(f"weights {made.weights[:12]}, not {runs.weights[:12]}")
    if made.sensor != runs.sensor:
        told.append(f"sensor {made.sensor!r}, not {runs.sensor!r}")
    for name in sorted({*made.settings, *runs.settings}):
        theirs, mine = made.settings.get(name), runs.settings.get(name)
        if mine != theirs:
            told.append(f"{name} {theirs}, not {mine}")
    if told:
        raise InputError(path, f"calibrated for {'; '.join(told)}", _AGAIN)
