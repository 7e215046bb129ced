"""What result.json says: scores in one unit, and strict JSON."""

import json

import numpy as np
import pytest

from prism_jax import metrics, result
from prism_jax.result import plain, score
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)


def test_scores_are_in_workspace_units():
    completed = FakeCompleter().complete(POINTS)
    truth = POINTS + np.float32(0.01)
    measured = score(completed, truth)
    center, half = completed.workspace.center, completed.workspace.half_extent
    clouds = {
        "partial": POINTS,
        "network_output": completed.prediction,
        "completed": completed.points,
    }
    for name, cloud in clouds.items():
        pair = (cloud.astype(np.float64) - center) / half, (truth - center) / half
        assert measured[name] == {
            "cd_l1": metrics.cd_l1(*pair),
            "cd_l2": metrics.cd_l2(*pair),
            "f_score": metrics.f_score(*pair, 0.01),
            "hausdorff": metrics.hausdorff(*pair),
        }
    assert measured["partial"]["cd_l1"] == pytest.approx(0.01 / half * 3**0.5, rel=0.2)


def test_scores_of_huge_clouds_are_of_an_even_sample(monkeypatch):
    completed = FakeCompleter().complete(POINTS)
    monkeypatch.setattr(result, "MAX_SCORED_POINTS", 100)
    measured = score(completed, POINTS)
    assert measured["max_points"] == 100
    assert measured == score(completed, POINTS)
    assert measured["partial"]["cd_l1"] == 0.0


def test_plain_is_strict_json():
    value = {
        "a": np.float32(0.5),
        "b": np.array([[1, 2]]),
        "c": (float("nan"), np.inf, None, True, "x"),
        "d": {"e": np.bool_(False), "f": np.array([np.nan, 1.0])},
    }
    expected = {
        "a": 0.5,
        "b": [[1, 2]],
        "c": [None, None, None, True, "x"],
        "d": {"e": False, "f": [None, 1.0]},
    }
    assert plain(value) == expected
    json.dumps(plain(value), allow_nan=False)
