"""Verdicts: trees over evidence, what is familiar, and what is said."""

import json

import numpy as np
import pytest

from prism_jax.uncertainty.confidence import EVIDENCE, SMALLEST, Calibration, logarithms

NAMES = list(EVIDENCE)
COUNT = len(NAMES)
USUAL = dict.fromkeys(NAMES, 0.05)


def stump(name, low, high, at=0.0):
    """A tree of depth two that adds the one below so many spreads of the evidence, and
    above it the other; its lower nodes look at nothing."""
    threshold = logarithms(USUAL)[NAMES.index(name)] + at
    return [NAMES.index(name), 0, 0], [threshold, 0, 0], [low, low, high, high]


def calibration(*stumps, **changes):
    """The error doubles above one spread of novelty and again above two; all else does
    not matter."""
    double = np.log(2.0)
    stumps = stumps or [stump("novelty", 0, double, n - 0.5) for n in (1, 2)]
    looks_at, thresholds, leaves = (
        np.array(part, float) for part in zip(*stumps, strict=True)
    )
    fields = {
        "usual": logarithms(USUAL),
        "base": np.log(0.01),
        "looks_at": looks_at,
        "thresholds": thresholds,
        "leaves": leaves,
        "bounds": np.log([0.001, 0.1]),
        "fair": 0.015,
        "low": 0.03,
        "feature_mean": np.arange(4.0),
        "feature_axes": np.array([[0.5, 0, 0, 0], [0, 1.0, 0, 0]]),
        "feature_rest": 3.0,
    }
    return Calibration(**{**fields, **changes})


def spreads(**off):
    """Evidence so many spreads above the usual."""
    moved = {n: (USUAL[n] + SMALLEST) * np.exp(s) - SMALLEST for n, s in off.items()}
    return {**USUAL, **moved}


def test_trust_falls_as_the_expected_error_grows():
    """It is the trees' sum, in the user's unit."""
    for off, trust, error in (
        (0.0, "high", 0.01),
        (0.4, "high", 0.01),
        (0.7, "fair", 0.02),
        (2.0, "low", 0.04),
    ):
        verdict = calibration().judge(spreads(novelty=off), half_extent=500.0)
        assert verdict.expected_error == pytest.approx(500 * error)
        assert verdict.trust == trust
        assert bool(verdict.reasons) == (trust != "high")


def test_the_reasons_are_what_makes_the_error_large_the_worst_first():
    found = calibration(
        stump("novelty", 0, 0.35, 0.4),
        stump("strays", 0, 1.0, 0.5),
        stump("num_points", 1.5, 0, -0.5),
        low=0.011,
    )
    evidence = spreads(novelty=0.5, strays=1.0, num_points=-1.0)
    few, strays, novel = found.judge(evidence, 1.0).reasons
    assert few.startswith("few points") and novel.startswith("the scan i")
    assert strays.startswith(f"{evidence['strays']:.0%} of the")
    assert found.judge(USUAL, 1.0).reasons == ()


@pytest.mark.parametrize(("name", "usual_side"), [("num_points", 1), ("strays", -1)])
def test_what_speaks_for_a_completion_is_no_reason_against_it(name, usual_side):
    """Trees that call many points, or no strays at all, a bad sign."""
    high = np.log(8.0)
    leaves = (0, high) if usual_side > 0 else (high, 0)
    found = calibration(stump(name, *leaves, at=0.5 * usual_side))
    verdict = found.judge(spreads(**{name: usual_side}), 1.0)
    assert verdict.trust == "low" and verdict.reasons == ()
    none = found.judge({**USUAL, "strays": 0.004}, 1.0)  # no share that reads as 0 %
    assert none.reasons == ()


def test_novelty_is_the_distance_in_spreads():
    """1 at one spread along each axis and as much beside them."""
    found, mean = calibration(), np.arange(4.0)
    assert found.novelty(mean) == 0.0
    off = np.array([2.0, 1.0, 3.0, 0.0])
    assert found.novelty(mean + off) == pytest.approx(1.0)
    assert found.novelty(mean + [0, 0, 0, 30.0]) == pytest.approx(10 / np.sqrt(3))


def test_it_goes_through_json():
    found = calibration(fair=1 / 3, low=2 / 3)
    again = Calibration.from_dict(json.loads(json.dumps(found.to_dict())))
    assert again.fair == pytest.approx(1 / 3, rel=1e-5)
    for evidence in (USUAL, spreads(novelty=1.7, strays=2)):
        expected = found.expected_error(evidence)
        assert again.expected_error(evidence) == pytest.approx(expected, rel=1e-4)
    assert again.novelty(np.ones(4)) == pytest.approx(found.novelty(np.ones(4)))


TABLES = "looks_at", "thresholds", "leaves"
DAMAGED = [
    {"low": 0.0},
    {"usual": ["a"] * COUNT},
    {"leaves": [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]},
    {"looks_at": [[0.0, COUNT, 0.0], [0.0, 0.0, 0.0]]},
    {"looks_at": [[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]]},
    {"feature_axes": [[1.0], [1.0, 2.0]]},
    {"bounds": [float("nan"), 1.0]},
    {"bounds": [1.0, 0.0]},
    {"bounds": [0.0, 800.0]},
    {"base": 10**400},
    {name: [[0.0] * (3 + (name == "leaves"))] * 1001 for name in TABLES},
    {"more": 1},
]


@pytest.mark.parametrize("change", DAMAGED)
def test_a_damaged_one_is_refused(change):
    with pytest.raises(ValueError, match="a calibration"):
        Calibration.from_dict({**calibration().to_dict(), **change})


def test_whatever_the_evidence_the_error_is_within_what_was_met():
    wild = calibration(stump("novelty", -1e3, 1e3))
    np.testing.assert_allclose(logarithms(dict.fromkeys(NAMES, 0.0)), np.log(SMALLEST))
    for value, error in ((0.0, 0.001), (1e-12, 0.001), (1e12, 0.1)):
        verdict = wild.judge(dict.fromkeys(NAMES, value), 1.0)
        assert verdict.expected_error == pytest.approx(error)
