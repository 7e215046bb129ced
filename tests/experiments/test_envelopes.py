"""The tables of experiments.envelopes, from cells that are made up."""

import numpy as np
import pytest
import trimesh

from experiments import envelopes
from experiments.envelope_tables import markdown
from experiments.envelopes import METHODS, SAMPLE, SPACING, Hull, Scored

RNG = np.random.default_rng(0)


def cell(score, tested=True, sigma=False):
    scores = {name: score for name in METHODS}
    if not sigma:
        scores["scaled"] = np.nan
    away = {name: np.linspace(0, 2, SAMPLE) for name in METHODS}
    counts = dict.fromkeys(("all", "objects"), 1000) | {
        "all_freed": 1,
        "objects_freed": 2,
        "all_freed_naively": 90,
        "objects_freed_naively": 50,
    }
    return Scored(
        scores,
        away if tested else {},
        np.arange(SAMPLE) % 2 == 0,
        np.zeros(10, bool),
        counts if tested else {},
        {"query": 0.004, "ready": 0.1},
    )


def found(low, high):
    """20 cells of even scores, and 20 others of which half need more."""
    calibration = [cell(score, tested=False) for score in np.linspace(low, high, 20)]
    others = [cell(high / 10, tested=False)] * 20
    tested = [cell(low)] * 10 + [cell(2 * high)] * 10
    return {"calibration": calibration, "test": tested, "other_arms": others}


def result(low, high):
    told = envelopes.tables(found(low, high), (0.1, 0.05))
    return {
        "weights": "small",
        "num_cells": 20,
        "commit": None,
        "robot": {"unknown": told, "known": told},
    }


def test_rows_hold_margins_coverage_and_volumes():
    told = envelopes.tables(found(0.1, 0.29), (0.1, 0.05))
    rows = [row for row in told["rows"] if row["calibrated_on"] == "calibration"]
    assert len(rows) == 2 * (len(METHODS) - 1)
    by_alpha = {row["alpha"]: row for row in rows if row["method"] == "completed"}
    # The 19th and the 20th of 20 scores.
    assert by_alpha[0.1]["q"] == pytest.approx(0.28)
    assert by_alpha[0.05]["q"] == pytest.approx(0.29)
    assert by_alpha[0.1]["covered"] == 10 and by_alpha[0.1]["tested"] == 20
    low, high = by_alpha[0.1]["interval"]
    assert low < 0.5 < high
    # Half of what is nearer than q and half a voxel's diagonal, of 27 cubic metres.
    reached = (0.28 + 0.5 * np.sqrt(3) * 0.04) / 2
    assert by_alpha[0.1]["volume"] == pytest.approx(27 * reached / 2, rel=0.01)
    assert by_alpha[0.1]["share_of_unseen"] == pytest.approx(reached, rel=0.01)
    assert told["unseen_volume"] == pytest.approx(13.5)
    assert told["cells_with_none_freed"] == 20


def test_the_page_says_whether_completion_pays():
    text = markdown(result(0.1, 0.29))
    assert "q is 0.28 m with completion and 0.28 m without" in text
    assert "does not pay" not in text
    assert "| 0.100% | 0.200% | 9.0% | 4.0, at most 4.0 for 1,000 points" in text
    assert "Completion does not pay there: " in markdown(result(0.3, 0.6))


@pytest.mark.parametrize("shift", [0.0, 1000.0])
def test_the_distance_from_a_hull_is_that_from_a_box(shift):
    box = trimesh.creation.box((1.0, 0.6, 0.4))
    inner = RNG.uniform(-0.5, 0.5, (50, 3)) * (1.0, 0.6, 0.4)
    hull = Hull(np.concatenate([box.vertices, inner]) + shift)
    points = RNG.uniform(-1, 1, (300, 3))
    gap = np.maximum(np.abs(points) - np.array([0.5, 0.3, 0.2]), 0.0)
    expected = np.linalg.norm(gap, axis=1)
    away = hull.distance(points + shift)
    assert (away[expected == 0] == 0).all()
    assert (away >= expected - 1e-6).all()
    assert (away <= expected + SPACING).all()
