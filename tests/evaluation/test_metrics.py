"""Metrics: the parity values, brute force, and faults that are named."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist, directed_hausdorff

from prism_jax.evaluation import metrics

RNG = np.random.default_rng(3)
NAMES = {
    "cd_l2": lambda *clouds: metrics.score(*clouds).cd_l2,
    "cd_l1": lambda *clouds: metrics.score(*clouds).cd_l1,
    "fscore_0.01": metrics.f_score,
    "fscore_0.02": lambda p, t: metrics.f_score(p, t, threshold=0.02),
    "hausdorff_sym_max": lambda *clouds: metrics.score(*clouds).hausdorff,
    "emd_exact_mean_l2": metrics.emd,
}


def cloud(count: int) -> np.ndarray:
    return RNG.normal(size=(count, 3))


def test_agrees_with_the_reference(reference):
    arrays = reference("metrics.npz")
    values = [name.split("/")[1:] for name in arrays if name.startswith("val/")]
    found = [(pair, name) for pair, name in values if name in NAMES]
    assert {pair for pair, _ in found} >= {"rand", "sphere_noisy"}
    for pair, name in found:
        clouds = arrays[f"cloud/{pair}/pred"], arrays[f"cloud/{pair}/gt"]
        value, expected = NAMES[name](*clouds), arrays[f"val/{pair}/{name}"]
        assert np.isclose(value, expected, rtol=1e-9), (pair, name)


def test_agrees_with_all_pairs():
    prediction, target = cloud(70), cloud(90)
    distances = cdist(prediction, target)
    forward, backward = distances.min(1), distances.min(0)
    precision, recall = np.mean(forward < 0.5), np.mean(backward < 0.5)
    expected = {
        "cd_l1": (forward.mean() + backward.mean()) / 2,
        "cd_l2": np.mean(forward**2) + np.mean(backward**2),
        "f_score": 2 / (1 / precision + 1 / recall),
        "hausdorff": max(
            directed_hausdorff(prediction, target)[0],
            directed_hausdorff(target, prediction)[0],
        ),
    }
    scores = metrics.score(prediction, target, 0.5)
    assert scores.emd is None and scores.named() == pytest.approx(expected)
    known = metrics.from_distances(forward, backward, 0.5)
    assert known.named() == pytest.approx(expected)


def test_the_unseen_of_two_planes_and_of_single_points():
    """A third of a plane lacks points; half of those there lie above it."""
    places = np.indices((12, 3)).reshape(2, -1).T / 3.0
    truth, side = np.column_stack([places, np.zeros(36)]), 4.0
    for above, near in ((0.005, (1, 1)), (0.015, (0.5, 1)), (0.03, (0.5, 0.5))):
        added = truth[:24] + above * side * np.outer(np.arange(24) % 2, [0, 0, 1])
        apart = cdist(added, truth)
        found = metrics.unseen_scores(apart.min(1), apart.min(0), side)
        for end, share in zip(metrics.REACHES, near, strict=True):
            f = 0.8 * share  # of a precision `share` and two thirds of it
            expected = {"precision": share, "recall": 2 / 3 * share, "f": f}
            for name, value in expected.items():
                assert found[f"{name}_{end}"] == pytest.approx(value)
    none, one = np.zeros(0), np.zeros(1)
    assert metrics.unseen_scores(none, none, 1.0) == {}
    kept = {"recall_1": 1, "f_1": 0, "recall_2": 1, "f_2": 0}
    assert metrics.unseen_scores(none, one, 1.0) == kept
    # A truth that is one point, and added points that hit or miss it.
    assert metrics.unseen_scores(one, one, 0.0)["f_1"] == 1
    assert metrics.unseen_scores(one + 1, one + 1, 0.0)["f_2"] == 0


def test_f_score_threshold_is_strict_and_unsquared():
    one = np.zeros((1, 3))
    two = np.asarray([[0.0, 0.0, 0.0], [0.0, 0.0, 0.25]])
    # Precision and recall are one half and one, then the reverse.
    for clouds in ((two, one), (one, two)):
        assert np.isclose(metrics.f_score(*clouds, threshold=0.25), 2 / 3)
        assert metrics.f_score(*clouds, threshold=0.2500001) == 1.0
    assert metrics.f_score(one, one + 1.0) == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_equal_repeated_and_moved_clouds(name):
    metric, best = NAMES[name], float(name.startswith("fscore"))
    points, repeated = cloud(20), np.full((20, 3), 7.5)
    assert np.isclose(metric(points, points[::-1].copy()), best, atol=1e-6)
    assert metric(repeated, repeated) == best
    target = cloud(20)
    away = metric(points + 1e4, target + 1e4)
    assert np.isclose(away, metric(points, target), rtol=1e-6)


def test_faults_are_named():
    good, many = cloud(5), cloud(metrics.MAX_EXACT_POINTS + 1)
    nan, inf = (np.where(good == good[2, 1], bad, good) for bad in (np.nan, np.inf))
    for metric, prediction, target, fault in (
        (metrics.f_score, good[:0], good, "prediction is empty"),
        (metrics.f_score, nan, good, r"prediction has .* NaN"),
        (metrics.emd, good, inf, r"target has .* infinite"),
        (metrics.emd, good, cloud(6), "equal counts, not 5 and 6"),
        (metrics.emd, many, many, "up to 4096 points, not 4097"),
    ):
        with pytest.raises(ValueError, match=fault):
            metric(prediction, target)
