"""Verdicts: a quadratic of evidence, what is familiar, and what is said."""

import dataclasses
import json

import numpy as np
import pytest

from prism_jax.trust import EVIDENCE, SMALLEST, Calibration, logarithms, terms

NAMES = list(EVIDENCE)
COUNT = len(NAMES)
USUAL = dict.fromkeys(NAMES, 0.05)


def calibration(**changes):
    """The error doubles with each spread of novelty; all else does not matter."""
    coefficients = np.zeros(terms(np.zeros(COUNT)).size)
    coefficients[0] = np.log(0.01)
    coefficients[1 + NAMES.index("novelty")] = np.log(2.0)
    fields = {
        "center": logarithms(USUAL),
        "scale": np.ones(COUNT),
        "usual": np.zeros(COUNT),
        "coefficients": coefficients,
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


def test_the_expected_error_is_the_quadratic_in_the_users_units():
    found = calibration()
    assert found.expected_error(USUAL) == pytest.approx(0.01)
    assert found.expected_error(spreads(novelty=1)) == pytest.approx(0.02)
    verdict = found.judge(spreads(novelty=1), half_extent=500.0)
    assert verdict.expected_error == pytest.approx(10.0)
    assert verdict.evidence == spreads(novelty=1)


def test_terms_are_those_of_a_quadratic():
    x = np.random.default_rng(0).normal(size=(5, 3))
    a, b, c = x.T
    expected = [np.ones(5), a, b, c, a * a, a * b, a * c, b * b, b * c, c * c]
    np.testing.assert_allclose(terms(x), np.stack(expected, 1))
    np.testing.assert_allclose(terms(x[0]), terms(x)[0])


@pytest.mark.parametrize(
    ("off", "trust"), [(0.0, "high"), (0.5, "high"), (0.7, "fair"), (2.0, "low")]
)
def test_trust_falls_as_the_expected_error_grows(off, trust):
    verdict = calibration().judge(spreads(novelty=off), 1.0)
    assert verdict.trust == trust
    assert bool(verdict.reasons) == (trust != "high")


def test_nothing_beyond_what_was_met_is_expected():
    found = calibration()
    assert found.expected_error(spreads(novelty=50)) == pytest.approx(0.1)
    assert found.expected_error(spreads(novelty=-4)) == pytest.approx(0.01 / 16, rel=1)
    assert found.expected_error(spreads(novelty=-4)) >= 0.001


def test_the_reasons_are_what_makes_the_error_large_the_worst_first():
    coefficients = calibration().coefficients.copy()
    coefficients[1 + NAMES.index("strays")] = 1.0
    coefficients[1 + NAMES.index("num_points")] = -1.5
    found = calibration(coefficients=coefficients, low=0.011)
    low = found.judge(spreads(novelty=0.5, strays=1.0, num_points=-1.0), 1.0)
    assert low.trust == "low"
    assert [reason.split(":")[0][:10] for reason in low.reasons] == [
        "few points",
        f"{spreads(strays=1.0)['strays']:.0%} of the"[:10],
        "it looks u",
    ]
    none = found.judge(spreads(novelty=0.05, strays=0.05), 1.0)
    assert len(none.reasons) <= 1


def test_every_reason_can_be_said():
    for name, text in EVIDENCE.items():
        assert text.format(0.123), name
        assert ": " in text, "a reason has a remedy"


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
    for evidence in (USUAL, spreads(novelty=1.5, strays=2)):
        expected = found.expected_error(evidence)
        assert again.expected_error(evidence) == pytest.approx(expected, rel=1e-4)
    assert again.novelty(np.ones(4)) == pytest.approx(found.novelty(np.ones(4)))


@pytest.mark.parametrize(
    "change",
    [
        {"low": None},
        {"low": 0.0},
        {"low": [1.0]},
        {"scale": [0.0] * COUNT},
        {"center": [0.0]},
        {"center": ["a"] * COUNT},
        {"center": {"a": 1}},
        {"coefficients": [1.0]},
        {"feature_axes": [[1.0]]},
        {"feature_axes": [[1.0], [1.0, 2.0]]},
        {"bounds": [float("nan"), 1.0]},
        {"more": 1},
    ],
)
def test_a_damaged_one_is_refused(change):
    with pytest.raises(ValueError, match="a calibration"):
        Calibration.from_dict({**calibration().to_dict(), **change})


def test_one_that_lacks_something_is_refused():
    fields = calibration().to_dict()
    del fields["bounds"]
    for damaged in (fields, {}):
        with pytest.raises(ValueError, match="a calibration has"):
            Calibration.from_dict(damaged)


def test_whatever_the_evidence_the_error_is_finite():
    wild = dataclasses.replace(
        calibration(), coefficients=np.full(terms(np.zeros(COUNT)).size, 1e3)
    )
    for value in (0.0, 1e-12, 1e12):
        verdict = wild.judge(dict.fromkeys(NAMES, value), 1.0)
        assert 0 < verdict.expected_error <= 0.1 + 1e-12
