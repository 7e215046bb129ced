"""What result.json says: scores in one unit, and strict JSON."""

import json

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from prism_jax.evaluation import scoring
from prism_jax.reporting.summary import plain, score
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)


def test_scores_are_in_half_the_longest_side_of_the_truth():
    """Whatever the workspace, which is taken from the partial cloud."""
    completed = FakeCompleter().complete(POINTS)
    truth = POINTS * np.float32([3, 1, 1])
    measured = score(completed, truth)
    half = np.ptp(truth.astype(np.float64), axis=0).max() / 2
    assert abs(half / completed.workspace.half_extent - 1) > 0.5
    assert measured["unit_length"] == half
    assert measured["unit"] == "half the longest side of the complete cloud"
    clouds = {
        "partial": POINTS,
        "network": completed.prediction,
        "completed": completed.points,
    }
    assert list(measured["clouds"]) == list(clouds)
    near, target = clouds["completed"][300:] / half, truth.astype(np.float64) / half
    scaled = {name: cloud.astype(np.float64) / half for name, cloud in clouds.items()}
    for name, scores in scoring.score(scaled, scaled["partial"], target).items():
        assert measured["clouds"][name] == pytest.approx(scores.named())
    precision = np.mean(cdist(near, target).min(1) <= 0.04)
    assert measured["clouds"]["completed"]["precision_2"] == precision
    assert "precision_2" not in measured["clouds"]["partial"]


def test_every_point_counts_however_large_the_clouds():
    """Thinning would drop added points, and one scan would have several scores."""
    points = np.random.default_rng(1).uniform(1, 2, (70_000, 3)).astype(np.float32)
    completed = FakeCompleter().complete(points)
    completed.points[-1] = 50.0
    found = score(completed, points)["clouds"]["completed"]
    assert found["cd_l2"] == pytest.approx(4 * 3 * 48.0**2 / 105_000, rel=0.01)


def test_plain_is_strict_json():
    given = {"a": np.float32(0.5), "b": np.array([[1, 2]]), "c": (np.nan, True, "x")}
    given["d"] = {"e": np.bool_(False), "f": np.array([np.inf, 1.0])}
    wanted = {"a": 0.5, "b": [[1, 2]], "c": [None, True, "x"]}
    wanted["d"] = {"e": False, "f": [None, 1.0]}
    assert json.loads(json.dumps(plain(given), allow_nan=False)) == wanted
