"""Means, medians, and intervals over objects."""

import json

import numpy as np
import pytest

from prism_jax.evaluation.metrics import Scores
from prism_jax.evaluation.summary import ExampleScores, summarise

RNG = np.random.default_rng(1)


METRICS = Scores._fields


def result(values, views=1, accepted=None, factor=1.0):
    """Of two clouds, as it is read from a file: the network's metrics are `factor`
    times the partial's."""
    rows = []
    for i, value in enumerate(values):
        partial = Scores(*(float(value * (k + 1)) for k in range(len(METRICS))))
        network = Scores(*(factor * metric for metric in partial))
        category = ("even", "odd")[i // views % 2]
        was = None if accepted is None else accepted[i]
        clouds = {"partial": partial, "network": network}
        rows.append(ExampleScores(f"{i // views}/{i % views}", category, was, clouds))
    objects = np.arange(len(values)) // views
    summary = summarise(rows, ("even", "odd", "never"), objects)
    return json.loads(json.dumps(summary))


def test_means_by_category_and_all_together():
    found = result([1.0, 2.0, 3.0, 4.0, 5.0], factor=2.0)
    assert found["num_examples"] == found["num_objects"] == 5
    partial, network = (found["clouds"][name] for name in ("partial", "network"))
    expected = {metric: 6.0 * (k + 1) for k, metric in enumerate(METRICS)}
    assert network["mean"] == pytest.approx(expected)
    assert partial["mean"]["cd_l2"] == 3.0
    assert list(network["per_category"]) == ["even", "odd"]
    assert network["per_category"]["odd"]["cd_l2"] == 6.0
    assert partial["per_category"]["even"]["hausdorff"] == 15.0
    assert "accepted" not in found


def test_a_median_hangs_on_no_single_example():
    found = result([1.0, 2.0, 9.0, 1.0, 700.0])["clouds"]["partial"]
    assert (found["median"]["cd_l2"], found["median"]["cd_l1"]) == (2.0, 4.0)


def test_accepted_is_a_share():
    accepted = [True, False, True, True]
    assert result([1.0, 2.0, 3.0, 4.0], accepted=accepted)["accepted"] == 0.75


def test_intervals_agree_with_the_normal_approximation():
    values = RNG.normal(10.0, 2.0, 400)
    low, high = result(values)["clouds"]["network"]["intervals"]["cd_l2"]
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert np.isclose(low, values.mean() - half, atol=0.1 * half)
    assert np.isclose(high, values.mean() + half, atol=0.1 * half)


def test_equal_values_have_an_interval_of_no_width():
    assert result(np.full(7, 0.25))["clouds"]["network"]["intervals"]["cd_l2"] == [
        0.25,
        0.25,
    ]


def test_views_of_one_object_are_one_draw():
    """The same view many times narrows no interval."""
    values = RNG.uniform(1, 2, 30)
    once, often = result(values), result(np.repeat(values, 4), views=4)
    assert (often["num_examples"], often["num_objects"]) == (120, 30)
    often, once = (found["clouds"]["network"] for found in (often, once))
    for metric in METRICS:
        np.testing.assert_allclose(often["mean"][metric], once["mean"][metric])
        np.testing.assert_allclose(
            often["intervals"][metric], once["intervals"][metric]
        )


def test_an_object_whose_views_were_cut_off_weighs_less():
    assert result([1.0, 1.0, 4.0], views=2)["clouds"]["network"]["mean"]["cd_l2"] == 2.0


def test_values_of_every_example_are_kept_in_single_precision():
    values = RNG.uniform(0, 1, 20)
    kept = result(values)["per_example"]["clouds"]["network"]
    assert tuple(kept) == METRICS
    np.testing.assert_array_equal(np.float32(kept["cd_l2"]), np.float32(values))
    assert max(len(repr(value)) for value in kept["cd_l2"]) < 16
