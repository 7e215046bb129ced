"""All clouds of an example at once, against the metrics one by one."""

import numpy as np
import pytest

from prism_jax import metrics
from prism_jax.completion import keep_unmeasured
from prism_jax.data.ordering import farthest_point_order
from prism_jax.evaluation.scoring import EMD_POINTS, METRICS, Scene, score

RNG = np.random.default_rng(5)
COMPLETE = RNG.normal(size=(1500, 3)) * [1.0, 0.5, 0.2]
MEASURED = COMPLETE[COMPLETE[:, 0] > 0]
FEW = farthest_point_order(COMPLETE, EMD_POINTS)


def scene(**predictions) -> Scene:
    return Scene(COMPLETE, FEW, MEASURED, MEASURED[:200], predictions)


def one_by_one(cloud) -> dict[str, float]:
    few = farthest_point_order(cloud, EMD_POINTS)
    return {
        "cd_l2": metrics.cd_l2(cloud, COMPLETE),
        "cd_l1": metrics.cd_l1(cloud, COMPLETE),
        "f_score": metrics.f_score(cloud, COMPLETE),
        "emd": metrics.emd(few, FEW),
        "hd": metrics.hausdorff(cloud, COMPLETE),
    }


def test_shared_searches_change_no_score():
    output = RNG.normal(size=(300, 3)) * [1.0, 0.5, 0.2]
    unadapted = output + RNG.normal(scale=0.02, size=output.shape)
    clouds = {"control": MEASURED, "output": output, "unadapted": unadapted}
    for name, cloud in (("merged", output), ("merged_unadapted", unadapted)):
        keep = keep_unmeasured(cloud, MEASURED, MEASURED[:200])
        assert 0 < keep.sum() < len(keep)
        clouds[name] = np.concatenate([MEASURED, cloud[keep]])
    scores = score(scene(output=output, unadapted=unadapted))
    assert scores.keys() == clouds.keys()
    for name, cloud in clouds.items():
        assert tuple(scores[name]) == METRICS
        for metric, value in one_by_one(cloud).items():
            assert np.isclose(scores[name][metric], value, rtol=1e-12), (name, metric)


def test_the_predictions_alone_have_the_same_scores():
    output = RNG.normal(size=(300, 3))
    both = scene(output=output, unadapted=output + 0.01)
    whole, alone = score(both), score(both, with_measured=False)
    assert list(alone) == ["output", "unadapted"]
    for name, row in alone.items():
        assert row == pytest.approx(whole[name], rel=1e-12)
    same = scene(output=output, unadapted=output.copy())
    scores = score(same, with_emd=False, with_measured=False)
    assert list(scores) == ["output", "unadapted"]


def test_equal_predictions_have_equal_scores():
    output = RNG.normal(size=(300, 3))
    scores = score(scene(output=output, unadapted=output.copy()), with_emd=False)
    assert scores["unadapted"] == scores["output"]
    assert scores["merged_unadapted"] == scores["merged"]


def test_a_prediction_of_measured_points_adds_nothing():
    scores = score(scene(output=MEASURED[::3]), with_emd=False)
    assert scores["merged"] == scores["control"]


def test_a_prediction_far_from_all_that_was_measured_is_added_whole():
    away = MEASURED + [50.0, 0.0, 0.0]
    together = np.concatenate([MEASURED, away])
    merged = score(scene(output=away), with_emd=False)["merged"]
    assert np.isclose(merged["cd_l2"], metrics.cd_l2(together, COMPLETE), rtol=1e-12)
    assert "emd" not in merged


def test_the_right_answer_is_the_best_there_is():
    best = score(scene(output=COMPLETE))["output"]
    expected = {"cd_l2": 0, "cd_l1": 0, "f_score": 1, "emd": 0, "hd": 0}
    assert best == pytest.approx(expected, abs=1e-12)


def test_a_prediction_that_is_not_finite_is_refused():
    with pytest.raises(ValueError):
        score(scene(output=np.full((10, 3), np.nan)))
