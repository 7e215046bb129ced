"""All clouds of an example at once, against the metrics one by one."""

import numpy as np
import pytest

from prism_jax import metrics
from prism_jax.data.ordering import farthest_point_order
from prism_jax.evaluation.scoring import CLOUDS, EMD_POINTS, ExampleClouds, score
from prism_jax.selection import keep_unmeasured

RNG = np.random.default_rng(5)
COMPLETE = RNG.normal(size=(1500, 3)) * [1.0, 0.5, 0.2]
MEASURED = COMPLETE[COMPLETE[:, 0] > 0]
FEW = farthest_point_order(COMPLETE, EMD_POINTS)


def example(network, unadapted=None) -> ExampleClouds:
    return ExampleClouds(COMPLETE, FEW, MEASURED, MEASURED[:200], network, unadapted)


def one_by_one(cloud) -> dict[str, float]:
    few = farthest_point_order(cloud, EMD_POINTS)
    return {
        "cd_l2": metrics.cd_l2(cloud, COMPLETE),
        "cd_l1": metrics.cd_l1(cloud, COMPLETE),
        "f_score": metrics.f_score(cloud, COMPLETE),
        "emd": metrics.emd(few, FEW),
        "hausdorff": metrics.hausdorff(cloud, COMPLETE),
    }


def test_shared_searches_change_no_score():
    output = RNG.normal(size=(300, 3)) * [1.0, 0.5, 0.2]
    unadapted = output + RNG.normal(scale=0.02, size=output.shape)
    clouds = {
        "partial": MEASURED,
        "network": output,
        "network_unadapted": unadapted,
    }
    for suffix, cloud in (("", output), ("_unadapted", unadapted)):
        keep = keep_unmeasured(cloud, MEASURED, MEASURED[:200])
        assert 0 < keep.sum() < len(keep)
        clouds[f"completed{suffix}"] = np.concatenate([MEASURED, cloud[keep]])
    scores = score(example(output, unadapted))
    assert scores.keys() == clouds.keys()
    assert tuple(scores) == CLOUDS
    for name, cloud in clouds.items():
        found = scores[name].named()
        both = found.pop("prediction_to_truth") + found.pop("truth_to_prediction")
        assert np.isclose(both, found["cd_l2"], rtol=1e-12)
        assert found == pytest.approx(one_by_one(cloud), rel=1e-12), name


def test_the_predictions_alone_have_the_same_scores():
    output = RNG.normal(size=(300, 3))
    both = example(output, output + 0.01)
    whole, alone = score(both), score(both, with_measured=False)
    assert list(alone) == ["network_unadapted", "network"]
    for name, row in alone.items():
        assert row == pytest.approx(whole[name], rel=1e-12)
    same = example(output, output.copy())
    scores = score(same, with_emd=False, with_measured=False)
    assert list(scores) == ["network_unadapted", "network"]


def test_equal_predictions_have_equal_scores():
    output = RNG.normal(size=(300, 3))
    scores = score(example(output, output.copy()), with_emd=False)
    assert scores["network_unadapted"] == scores["network"]
    assert scores["completed_unadapted"] == scores["completed"]


def test_a_prediction_of_measured_points_adds_nothing():
    scores = score(example(MEASURED[::3]), with_emd=False)
    assert scores["completed"] == scores["partial"]


def test_a_prediction_far_from_all_that_was_measured_is_added_whole():
    away = MEASURED + [50.0, 0.0, 0.0]
    together = np.concatenate([MEASURED, away])
    completed = score(example(away), with_emd=False)["completed"]
    assert np.isclose(completed.cd_l2, metrics.cd_l2(together, COMPLETE), rtol=1e-12)
    assert completed.emd is None


def test_the_right_answer_is_the_best_there_is():
    best = score(example(COMPLETE))["network"].named()
    assert best.pop("f_score") == 1
    assert best == pytest.approx(dict.fromkeys(best, 0), abs=1e-12)


def test_a_prediction_that_is_not_finite_is_refused():
    with pytest.raises(ValueError):
        score(example(np.full((10, 3), np.nan)))
