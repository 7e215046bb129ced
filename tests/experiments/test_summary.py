"""Means, and intervals over objects."""

import json

import numpy as np
import pytest

from experiments import paired
from experiments.summary import ExampleScores, summarise
from prism_jax.evaluation.metrics import Scores

METRICS = Scores._fields


def result(values, views=1, accepted=None, factor=1.0):
    """Of two clouds, as it is read from a file: the network's metrics are `factor`
    times the partial's."""
    rows = []
    for i, value in enumerate(values):
        partial = Scores(*(float(value * (k + 1)) for k in range(len(METRICS))))
        network = Scores(*(factor * metric for metric in partial))
        category = ("even", "odd")[i // views % 2]
        was = None if accepted is None else bool(accepted[i])
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


def test_what_examples_lack_is_left_out_and_accepted_is_a_share():
    """Of the odd ones none has the metric, nor any of another."""
    kinds = ["even", "odd"] * 2 + ["even"]
    scores, values = Scores(*np.arange(1.0, 6.0)), [0.25, None, 0.5, None, 0.25]
    rows = [
        ExampleScores("", kind, i < 3, {"network": scores._replace(f_2=f)})
        for i, (kind, f) in enumerate(zip(kinds, values, strict=True))
    ]
    found = summarise(rows, ("even", "odd"), np.arange(5))
    network, each = found["clouds"]["network"], found["per_example"]["clouds"]
    assert found["accepted"] == 0.6 and network["of"] == {"f_2": 3}
    assert network["mean"]["f_2"] == pytest.approx(1 / 3)
    assert network["intervals"]["f_2"] == [0.25, 0.5]
    assert "f_2" not in network["per_category"]["odd"]
    assert each["network"]["f_2"] == values
    assert "recall_2" not in network["mean"]


def test_intervals_agree_with_the_normal_approximation(monkeypatch):
    monkeypatch.setattr(paired, "_RESAMPLES", 2000)
    values = np.random.default_rng(1).normal(10.0, 2.0, 400)
    found = result(values)
    kept = found["per_example"]["clouds"]["network"]["cd_l2"]
    np.testing.assert_array_equal(np.float32(kept), np.float32(values))
    low, high = found["clouds"]["network"]["intervals"]["cd_l2"]
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert np.isclose(low, values.mean() - half, atol=0.1 * half)
    assert np.isclose(high, values.mean() + half, atol=0.1 * half)


def test_views_of_one_object_are_one_draw():
    """The same view many times narrows no interval."""
    values = np.random.default_rng(1).uniform(1, 2, 30)
    once, often = result(values), result(np.repeat(values, 4), views=4)
    assert (often["num_examples"], often["num_objects"]) == (120, 30)
    often, once = (found["clouds"]["network"] for found in (often, once))
    for metric in METRICS:
        np.testing.assert_allclose(often["mean"][metric], once["mean"][metric])
        np.testing.assert_allclose(
            often["intervals"][metric], once["intervals"][metric]
        )
    # An object whose views were cut off weighs less.
    cut_off = result([1.0, 1.0, 4.0], views=2)["clouds"]["network"]
    assert cut_off["mean"]["cd_l2"] == 2.0
