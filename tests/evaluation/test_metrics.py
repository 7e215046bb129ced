"""Metrics: the parity values, brute force, and faults that are named."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist, directed_hausdorff

from prism_jax.data.ordering import farthest_point_order
from prism_jax.evaluation import metrics

RNG = np.random.default_rng(3)
NAMES = {
    "cd_l2": metrics.cd_l2,
    "cd_l1": metrics.cd_l1,
    "fscore_0.01": metrics.f_score,
    "fscore_0.02": lambda p, t: metrics.f_score(p, t, threshold=0.02),
    "hausdorff_sym_max": metrics.hausdorff,
    "emd_exact_mean_l2": metrics.emd,
}
ALL = (
    metrics.cd_l1,
    metrics.cd_l2,
    metrics.f_score,
    metrics.hausdorff,
    metrics.emd,
)
PARITY_RTOL = 1e-9


def cloud(count: int) -> np.ndarray:
    return RNG.normal(size=(count, 3))


def test_agrees_with_the_reference(reference):
    arrays = reference("metrics.npz")
    pairs = {name.split("/")[1] for name in arrays if name.startswith("cloud/")}
    assert pairs >= {"rand", "sphere_noisy"}
    for pair in pairs:
        clouds = arrays[f"cloud/{pair}/pred"], arrays[f"cloud/{pair}/gt"]
        for name, metric in NAMES.items():
            if f"val/{pair}/{name}" in arrays:
                expected = arrays[f"val/{pair}/{name}"]
                found = metric(*clouds)
                assert np.allclose(found, expected, rtol=PARITY_RTOL), (pair, name)


def test_agrees_with_all_pairs():
    prediction, target = cloud(70), cloud(90)
    distances = cdist(prediction, target)
    forward, backward = distances.min(1), distances.min(0)
    precision, recall = np.mean(forward < 0.5), np.mean(backward < 0.5)
    assert np.isclose(
        metrics.cd_l1(prediction, target), (forward.mean() + backward.mean()) / 2
    )
    assert np.isclose(
        metrics.cd_l2(prediction, target), np.mean(forward**2) + np.mean(backward**2)
    )
    assert np.isclose(
        metrics.f_score(prediction, target, 0.5),
        2 / (1 / precision + 1 / recall),
    )
    assert np.isclose(
        metrics.hausdorff(prediction, target),
        max(
            directed_hausdorff(prediction, target)[0],
            directed_hausdorff(target, prediction)[0],
        ),
    )


def test_distances_serve_all_metrics():
    prediction, target = cloud(70), cloud(90)
    distances = cdist(prediction, target)
    forward, backward = distances.min(1), distances.min(0)
    scores = metrics.from_distances(forward, backward, 0.5)
    assert np.isclose(scores.cd_l2, metrics.cd_l2(prediction, target))
    assert np.isclose(scores.cd_l1, metrics.cd_l1(prediction, target))
    assert np.isclose(scores.f_score, metrics.f_score(prediction, target, 0.5))
    assert np.isclose(scores.hausdorff, metrics.hausdorff(prediction, target))
    assert np.isclose(scores.prediction_to_truth, np.mean(forward**2))
    assert np.isclose(scores.truth_to_prediction, np.mean(backward**2))
    assert scores.emd is None and "emd" not in scores.named()


def test_f_score_threshold_is_strict_and_unsquared():
    one = np.zeros((1, 3))
    two = np.asarray([[0.0, 0.0, 0.0], [0.0, 0.0, 0.25]])
    # Precision and recall are one half and one, then the reverse.
    for clouds in ((two, one), (one, two)):
        assert np.isclose(metrics.f_score(*clouds, threshold=0.25), 2 / 3)
        assert metrics.f_score(*clouds, threshold=0.2500001) == 1.0
    assert metrics.f_score(one, one + 1.0) == 0.0


def test_emd_is_the_best_of_all_assignments():
    prediction, target = cloud(5), cloud(5)
    best = min(
        np.linalg.norm(prediction - target[list(order)], axis=1).mean()
        for order in itertools.permutations(range(5))
    )
    assert np.isclose(metrics.emd(prediction, target), best)


@pytest.mark.parametrize("count", [63, 64, 200])
@pytest.mark.parametrize("order", ["farthest", "random", "sorted", "one point"])
def test_emd_is_the_assignment_of_the_costs_as_they_are(count, order):
    prediction, target = cloud(count), cloud(count) * [1.0, 2.0, 0.1] + [3.0, 0.0, 0.0]
    if order == "farthest":
        prediction = farthest_point_order(prediction, count)
        target = farthest_point_order(target, count)
    elif order == "sorted":
        prediction, target = np.sort(prediction, axis=0), -np.sort(-target, axis=0)
    elif order == "one point":
        target[: count // 2] = target[0]
        prediction[count // 3 :] = target[0]
    cost = cdist(prediction, target)
    expected = cost[linear_sum_assignment(cost)].mean()
    assert np.isclose(metrics.emd(prediction, target), expected, rtol=1e-12)
    others = [target[::-1] + 0.1, prediction, prediction + 0.01 * cloud(count)]
    values = metrics.emds([*others, prediction], target)
    for one, value in zip(others, values, strict=False):
        cost = cdist(one, target)
        best = cost[linear_sum_assignment(cost)].mean()
        assert np.isclose(value, best, rtol=1e-12)
    assert np.isclose(values[1], expected, rtol=1e-12)
    assert values[3] == values[1]
    assert metrics.emds([], target) == []


@pytest.mark.parametrize("metric", ALL)
def test_equal_and_repeated_clouds(metric):
    best = 1.0 if metric is metrics.f_score else 0.0
    points = cloud(20)
    assert np.isclose(metric(points, points[::-1].copy()), best, atol=1e-6)
    repeated = np.full((20, 3), 7.5)
    assert metric(repeated, repeated) == best
    assert metric(np.ones((1, 3)), np.ones((1, 3))) == best


@pytest.mark.parametrize("metric", ALL)
def test_shift_of_both_clouds_changes_nothing(metric):
    prediction, target = cloud(30), cloud(30)
    near = metric(prediction, target)
    assert np.isclose(metric(prediction + 1e4, target + 1e4), near, rtol=1e-6)


@pytest.mark.parametrize("metric", ALL)
def test_faults_are_named(metric):
    good, empty = cloud(5), np.zeros((0, 3))
    spoiled = cloud(5)
    spoiled[2, 1] = np.nan
    with pytest.raises(ValueError, match="prediction is empty"):
        metric(empty, good)
    with pytest.raises(ValueError, match="target is empty"):
        metric(good, empty)
    with pytest.raises(ValueError, match=r"prediction has .* NaN"):
        metric(spoiled, good)
    spoiled[2, 1] = np.inf
    with pytest.raises(ValueError, match=r"target has .* infinite"):
        metric(good, spoiled)


def test_emd_names_what_it_cannot_do():
    with pytest.raises(ValueError, match="equal counts, not 5 and 6"):
        metrics.emd(cloud(5), cloud(6))
    too_many = cloud(metrics.MAX_EXACT_POINTS + 1)
    with pytest.raises(ValueError, match="up to 4096 points, not 4097"):
        metrics.emd(too_many, too_many)
