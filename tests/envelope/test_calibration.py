import json

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import directed_hausdorff

from prism_jax.envelope.calibration import (
    MarginCalibration,
    Setup,
    cell_score,
    cells_needed,
    check_setup,
    conformal_margin,
    read_calibration,
)
from prism_jax.envelope.distance import Surfaces
from prism_jax.io.errors import InputError

RNG = np.random.default_rng(0)
SETUP = Setup("a" * 64, "camera 640x480", {"adapt": False, "density": 1.0})


def calibration(scores=None, n=20):
    scores = tuple(RNG.uniform(0.1, 0.5, n).tolist()) if scores is None else scores
    names = tuple(f"{i:03d}" for i in range(len(scores)))
    digests = tuple(name * 3 for name in names)
    return MarginCalibration(SETUP, 0.1, names, digests, scores, (0.8, 2.0))


def test_a_score_is_the_directed_hausdorff_distance():
    truth, cloud = RNG.random((80, 3)), RNG.random((50, 3))
    halves = Surfaces({"measured": cloud[:20], "predicted": cloud[20:]})
    expected = directed_hausdorff(truth, cloud)[0]
    assert cell_score(truth, halves) == pytest.approx(expected, rel=1e-12)
    assert cell_score(truth, Surfaces({})) == np.inf
    with pytest.raises(InputError, match="no points"):
        cell_score(np.zeros((0, 3)), halves)


def test_a_known_part_holds_no_more_than_its_own_margin_does():
    """Inflated by the score, a part by no more than its margin, surfaces hold all."""
    truth, cloud, part = RNG.random((3, 60, 3))
    for own in 0.0, 0.05, 0.2, 5.0:
        surfaces = Surfaces({"measured": cloud, "part": part}, own)
        score = cell_score(truth, surfaces)
        nearer = directed_hausdorff(truth, np.concatenate([cloud, part]))[0]
        assert nearer <= score <= directed_hausdorff(truth, cloud)[0]
        assert surfaces.distance(truth, score)[0].max() == pytest.approx(0, abs=1e-12)
        assert surfaces.distance(truth, 0.99 * score)[0].max() > 0
    assert score == pytest.approx(nearer)


@pytest.mark.parametrize(
    ("alpha", "needed"), [(0.1, 9), (0.05, 19), (0.01, 99), (0.2, 4), (0.5, 1)]
)
def test_fewer_cells_than_can_tell_are_refused_with_how_many_can(alpha, needed):
    assert cells_needed(alpha) == needed
    assert conformal_margin([1.0] * needed, alpha) == 1.0
    with pytest.raises(InputError, match=f"{needed - 1} cells.*on {needed} or more"):
        conformal_margin([1.0] * (needed - 1), alpha)


def test_the_margin_is_numpys_quantile_of_that_rank():
    for n, alpha in ((9, 0.1), (10, 0.1), (19, 0.05), (99, 0.1), (100, 0.05)):
        scores = RNG.random(n)
        level = min((1 - alpha) * (n + 1) / n, 1.0)
        expected = np.quantile(scores, level - 1e-12, method="inverted_cdf")
        assert conformal_margin(list(scores), alpha) == expected


def test_coverage_is_what_was_promised():
    """Of exchangeable cells, on average over calibrations; exact without ties."""
    n, alpha, trials = 19, 0.1, 4000
    drawn = RNG.standard_exponential((trials, n + 1))
    held = [row[-1] <= conformal_margin(list(row[:-1]), alpha) for row in drawn]
    exact = np.ceil((n + 1) * (1 - alpha)) / (n + 1)
    low, high = stats.binomtest(sum(held), trials).proportion_ci(0.999)
    assert low < exact < high


def test_a_margin_beyond_what_was_measured_is_refused():
    assert conformal_margin([0.1] * 18 + [np.inf], 0.1) == 0.1
    with pytest.raises(InputError, match="no finite margin"):
        conformal_margin([0.1] * 8 + [np.inf], 0.1)
    for alpha in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(InputError, match="alpha"):
            conformal_margin([0.1] * 50, alpha)


def test_a_file_is_read_back_and_checked_against_what_runs(tmp_path):
    path = tmp_path / "cal.json"
    one = calibration((0.2,) * 29 + (np.inf,))
    one.write(path)
    # A cell without any surface.
    assert json.loads(path.read_text())["scores"][-1] is None
    assert read_calibration(path) == one
    one = calibration()
    one.write(path)
    assert read_calibration(path) == one
    check_setup(one, SETUP, path)
    content = json.loads(path.read_text())
    assert content["n"] == 20 and content["weights_sha256"] == "a" * 64
    assert "People are never predicted" in content["notice"]
    for changed, told in (
        (
            Setup("b" * 64, SETUP.sensor, SETUP.settings),
            "weights aaaaaaaaaaaa, not bbbb",
        ),
        (Setup("a" * 64, "camera 9x9", SETUP.settings), "sensor 'camera 640x480'"),
        (Setup("a" * 64, SETUP.sensor, {"adapt": True, "density": 1.0}), "adapt False"),
        (Setup("a" * 64, SETUP.sensor, {"adapt": False}), "density 1.0, not None"),
    ):
        with pytest.raises(InputError, match=told) as refused:
            check_setup(one, changed, path)
        assert str(path) in str(refused.value) and "\n" not in str(refused.value)


CONTRADICTIONS = [
    {"format": "another"},
    {"q": 0.01},
    {"n": 19},
    {"scores": [0.1] * 19},
    {"scores": [-0.1] * 20},
    {"scores": [None] * 20},
    {"alpha": 0.001},
    {"cells": ["same"] * 20},
    {"digests": ["same"] * 20},
    {"digests": ["one"]},
    {"extent": [-1.0, 2.0]},
    {"extent": None},
    {"extent": [10**400, 1]},
    {"alpha": 1e-320},
    {"n": ["a" * 10**6]},
    {"settings": [["a", 1], [0, 1]]},
]


def test_files_that_contradict_themselves_or_are_none_are_refused(tmp_path):
    path, whole = tmp_path / "cal.json", calibration().to_dict()
    for content in [*(whole | change for change in CONTRADICTIONS), [], {"format": 1}]:
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match="calibrate again") as refused:
            read_calibration(path)
        assert len(str(refused.value)) < 1200
    for text in ("", "{", "[" * 100_000, '{"n": 1' + "0" * 5000 + "}"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"cal\.json: "):
            read_calibration(path)


def test_scans_out_of_all_scale_are_not_in_metres():
    points = RNG.random((100, 3))
    calibration().check_units(points)
    for unit in (1000.0, 100.0, 39.4, 0.001):
        with pytest.raises(InputError, match=r"calibrated on scans of 0\.8 to 2 m"):
            calibration().check_units(unit * points)
