"""Means, intervals over objects, and paired differences."""

import json

import numpy as np
import pytest

from prism_jax.evaluation import paired_difference
from prism_jax.evaluation.scoring import METRICS
from prism_jax.evaluation.summary import Scores, summarise

RNG = np.random.default_rng(1)


def rows(values, views=1, accepted=None, factor=1.0) -> list[Scores]:
    """Two clouds a row; the output's metrics are `factor` times the control's."""
    made = []
    for i, value in enumerate(values):
        control = {metric: float(value * (k + 1)) for k, metric in enumerate(METRICS)}
        output = {metric: factor * x for metric, x in control.items()}
        category = ("even", "odd")[i // views % 2]
        was = None if accepted is None else accepted[i]
        clouds = {"control": control, "output": output}
        made.append(Scores(f"{i // views}/{i % views}", category, was, clouds))
    return made


def result(values, **how):
    """As it is read from a file."""
    views = how.get("views", 1)
    objects = np.arange(len(values)) // views
    summary = summarise(rows(values, **how), ("even", "odd", "never"), objects)
    return json.loads(json.dumps(summary))


def test_means_by_category_and_all_together():
    found = result([1.0, 2.0, 3.0, 4.0, 5.0], factor=2.0)
    assert found["num_examples"] == found["num_objects"] == 5
    expected = dict(zip(METRICS, (6.0, 12.0, 18.0, 24.0, 30.0), strict=True))
    assert found["mean"] == pytest.approx(expected)
    assert found["control"]["mean"]["cd_l2"] == 3.0
    assert list(found["per_category"]) == ["even", "odd"]
    assert found["per_category"]["odd"]["cd_l2"] == 6.0
    assert found["control"]["per_category"]["even"]["hd"] == 15.0
    assert "accepted" not in found


def test_accepted_is_a_share():
    accepted = [True, False, True, True]
    assert result([1.0, 2.0, 3.0, 4.0], accepted=accepted)["accepted"] == 0.75


def test_intervals_agree_with_the_normal_approximation():
    values = RNG.normal(10.0, 2.0, 400)
    low, high = result(values)["intervals"]["cd_l2"]
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert np.isclose(low, values.mean() - half, atol=0.1 * half)
    assert np.isclose(high, values.mean() + half, atol=0.1 * half)


def test_equal_values_have_an_interval_of_no_width():
    assert result(np.full(7, 0.25))["intervals"]["cd_l2"] == [0.25, 0.25]


def test_views_of_one_object_are_one_draw():
    """The same view many times narrows no interval."""
    values = RNG.uniform(1, 2, 30)
    once, often = result(values), result(np.repeat(values, 4), views=4)
    assert (often["num_examples"], often["num_objects"]) == (120, 30)
    np.testing.assert_allclose(often["mean"]["hd"], once["mean"]["hd"])
    for metric in METRICS:
        np.testing.assert_allclose(
            often["intervals"][metric], once["intervals"][metric]
        )


def test_an_object_whose_views_were_cut_off_weighs_less():
    assert result([1.0, 1.0, 4.0], views=2)["mean"]["cd_l2"] == 2.0


def test_values_of_every_example_are_kept_in_single_precision():
    values = RNG.uniform(0, 1, 20)
    kept = result(values)["per_example"]["output"]
    assert kept.keys() == {"cd_l2", "f_score"}
    np.testing.assert_array_equal(np.float32(kept["cd_l2"]), np.float32(values))
    assert max(len(repr(value)) for value in kept["cd_l2"]) < 16


def test_a_tenth_lower_everywhere_is_a_tenth_lower():
    values = RNG.uniform(0.1, 9, 50)
    a, b = result(values), result(values, factor=0.9)
    found = paired_difference(a, b)
    assert np.isclose(found["change"], -0.1, atol=1e-6)
    np.testing.assert_allclose(found["interval"], [-0.1, -0.1], atol=1e-6)
    assert (found["num_examples"], found["num_objects"]) == (50, 50)
    inside = paired_difference(b, b, "f_score", ("control", "output"))
    assert np.isclose(inside["change"], -0.1, atol=1e-6)


def test_the_change_is_of_the_means_and_its_interval_of_pairs():
    values = RNG.lognormal(0, 2, 300)
    noise = RNG.normal(0, 0.01, 300)
    a, b = result(values), result(values * 1.05 + noise)
    found = paired_difference(a, b)
    exact = (values * 1.05 + noise).mean() / values.mean() - 1
    assert np.isclose(found["change"], exact, rtol=1e-4)
    low, high = found["interval"]
    assert low < found["change"] < high
    # What is hard for both cancels: the means' own intervals are far wider.
    wide = np.diff(a["intervals"]["cd_l2"])[0] / a["mean"]["cd_l2"]
    assert high - low < 0.05 * wide


def test_two_results_without_a_difference_straddle_zero():
    values = RNG.uniform(1, 2, 200)
    other = values + RNG.normal(0, 0.1, 200)
    other += values.mean() - other.mean()
    low, high = paired_difference(result(values), result(other))["interval"]
    assert low < 0 < high


def test_what_cannot_be_compared_is_refused():
    a = result([1.0, 2.0])
    with pytest.raises(ValueError, match="not of the same examples"):
        paired_difference(a, result([1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match="not of the same examples"):
        paired_difference(a, result([1.0, 2.0], views=2))
    with pytest.raises(ValueError, match="has no emd of output"):
        paired_difference(a, a, "emd")
    with pytest.raises(ValueError, match="has no cd_l2 of unadapted"):
        paired_difference(a, a, clouds=("unadapted", "output"))
    with pytest.raises(ValueError, match="no cd_l2 of name"):
        paired_difference(a, a, clouds=("name", "output"))
    with pytest.raises(ValueError, match="is zero"):
        paired_difference(result([0.0, 0.0]), a)
