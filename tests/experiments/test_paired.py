"""Paired differences: their intervals over objects and categories, and who carries
them."""

import numpy as np
import pytest

from experiments.paired import adaptation_effect, all_differences, paired_difference
from prism_jax.evaluation.tables import MEASURES

RNG = np.random.default_rng(1)


@pytest.fixture
def quick_scores():
    """Nothing: as many draws as the figures have."""


def result(values, views=1, categories=None, **clouds):
    """A result's values of every example, all metrics alike; `clouds` besides
    ``network``."""
    objects = np.arange(len(values)) // views
    kinds = ["bag"] * len(values) if categories is None else list(categories)
    metrics = {metric for metric, *_ in MEASURES.values()}
    return {
        "per_example": {
            "name": [f"{i // views}/{i % views}" for i in range(len(values))],
            "category": kinds,
            "object": objects.tolist(),
            "clouds": {
                name: {metric: list(cloud) for metric in metrics}
                for name, cloud in {"network": values, **clouds}.items()
            },
        }
    }


def test_a_tenth_lower_everywhere_is_a_tenth_lower():
    values = RNG.uniform(0.1, 9, 50)
    a, b = result(values), result(0.9 * values, partial=values)
    for statistic in ("mean", "log mean"):
        found = paired_difference(a, b, statistic=statistic)
        assert np.isclose(found["change"], -0.1)
        np.testing.assert_allclose(found["interval"], [-0.1, -0.1])
        assert (found["num_examples"], found["num_objects"]) == (50, 50)
        assert not {"category_interval", "carried_by"} & found.keys()
    inside = paired_difference(b, b, "f_2", ("partial", "network"))
    assert np.isclose(inside["change"], -0.1)


def test_the_change_is_of_the_means_and_its_interval_of_pairs():
    values = RNG.lognormal(0, 2, 300)
    after = values * 1.05 + RNG.normal(0, 0.01, 300)
    found = paired_difference(result(values), result(after))
    assert np.isclose(found["change"], after.mean() / values.mean() - 1)
    low, high = found["interval"]
    assert low < found["change"] < high
    logs = paired_difference(result(values), result(values**2), statistic="log mean")
    assert np.isclose(logs["change"], np.exp(np.log(values).mean()) - 1)
    # Another view of the same object narrows nothing.
    twice = (result(np.repeat(cloud, 2), views=2) for cloud in (values, after))
    assert paired_difference(*twice)["interval"] == pytest.approx(found["interval"])
    # What is hard for both cancels: the mean's own interval is far wider.
    error = values.std() / np.sqrt(len(values)) / values.mean()
    assert high - low < 0.05 * error


def test_a_single_category_carries_the_whole_effect():
    """As one kind of six: significant over objects, nothing over kinds."""
    kinds = np.repeat([f"kind {i}" for i in range(6)], 20)
    rest = kinds != "kind 2"
    before = RNG.uniform(1, 2, 120) + 4 * ~rest
    after = before * np.where(rest, 1.0, 0.9) + RNG.normal(0, 0.01, 120)
    found = paired_difference(
        result(before, categories=kinds), result(after, categories=kinds)
    )
    assert found["interval"][1] < -0.02
    assert found["category_interval"][1] > -0.01
    assert found["num_categories"] == 6
    carrier = found["carried_by"]
    assert (carrier["category"], carrier["num_examples"]) == ("kind 2", 20)
    part = (after - before)[~rest].sum() / before.sum()
    assert np.isclose(carrier["contribution"], part)
    without = after[rest].mean() / before[rest].mean() - 1
    assert np.isclose(carrier["change_without"], without, atol=1e-12)
    low, high = carrier["interval_without"]
    assert low < without < high and high - low < 0.01
    # The largest of all is against the change, and does not carry it.
    kinds = ["up", "down", "down again"]
    ones, after = np.ones(3), np.array([1.5, 0.6, 0.7])
    found = paired_difference(
        result(ones, categories=kinds), result(after, categories=kinds)
    )
    assert np.isclose(found["change"], -0.2 / 3)
    assert found["carried_by"]["category"] == "down"


def test_examples_that_lack_the_metric_in_one_result_are_left_out():
    before, after = RNG.uniform(1, 2, (2, 6))
    kinds = ["bag", "bag", "car", "car", "car", "bus"]
    some_before, some_after = [None, *before[1:]], [*after[:5], None]
    a = result(some_before, categories=kinds)
    b = result(some_after, categories=kinds)
    found = paired_difference(a, b, "f_2")
    known = result(before[1:5], categories=kinds[1:5])
    wanted = paired_difference(known, result(after[1:5], categories=kinds[1:5]), "f_2")
    assert found == wanted and found["num_examples"] == 4
    nothing = result([None] * 6, categories=kinds)
    assert all_differences(a, nothing, ("network", "network")) == {}


def test_adaptation_is_told_of_every_cloud_that_was_adapted():
    values = RNG.uniform(1, 2, 10)
    found = adaptation_effect(result(0.5 * values, network_unadapted=values))
    assert list(found) == ["network"] and list(found["network"]) == list(MEASURES)
    assert all(np.isclose(c["change"], -0.5) for c in found["network"].values())
    assert adaptation_effect(result(values)) == {}


def test_what_cannot_be_compared_is_refused():
    a, zero = result([1.0, 2.0]), result([0.0, 0.0])
    other = result([1.0, 2.0], categories=["bag", "car"])
    with pytest.raises(ValueError, match="not of the same examples"):
        paired_difference(a, other)
    with pytest.raises(ValueError, match="no example has emd of network"):
        paired_difference(a, a, "emd")
    with pytest.raises(ValueError, match="is zero"):
        paired_difference(zero, a)
