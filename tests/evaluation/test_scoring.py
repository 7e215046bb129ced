"""All clouds of an example at once, against the metrics one by one."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from prism_jax.data.ordering import farthest_point_order
from prism_jax.evaluation import metrics, scoring
from prism_jax.evaluation.scoring import CLOUDS, score

RNG = np.random.default_rng(5)
COMPLETE = RNG.normal(size=(1500, 3)) * [1.0, 0.5, 0.2]
MEASURED = COMPLETE[COMPLETE[:, 0] > 0]
EMD_POINTS = 128
FEW = farthest_point_order(COMPLETE, EMD_POINTS)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(scoring, "EMD_POINTS", EMD_POINTS)


def test_every_score_is_that_of_the_metric():
    output = RNG.normal(size=(300, 3)) * [1.0, 0.5, 0.2]
    unadapted = output + RNG.normal(scale=0.02, size=output.shape)
    clouds = {
        "partial": MEASURED,
        "network": output,
        "completed": np.concatenate([MEASURED, output[:100]]),
        "network_unadapted": unadapted,
        "completed_unadapted": np.concatenate([MEASURED, unadapted[:100]]),
    }
    scores = score(clouds, MEASURED, COMPLETE, FEW)
    assert tuple(scores) == CLOUDS
    side = np.ptp(COMPLETE, axis=0).max()
    unseen = COMPLETE[cdist(COMPLETE, MEASURED).min(1) > 0.02 * side]
    for name, cloud in clouds.items():
        few = farthest_point_order(cloud, EMD_POINTS)
        expected = metrics.score(cloud, COMPLETE)
        expected = expected._replace(emd=metrics.emd(few, FEW))
        if name != "partial":
            added = cloud[len(MEASURED) :] if "completed" in name else cloud
            apart = cdist(added, COMPLETE).min(1), cdist(unseen, cloud).min(1)
            expected = expected._replace(**metrics.unseen_scores(*apart, side))
            assert 0 < expected.recall_1 < expected.recall_2 < 1
        found = scores[name].named()
        assert found == pytest.approx(expected.named(), rel=1e-12), name


def test_the_right_answer_is_the_best_there_is():
    """Under one name or two. Only what is there is scored."""
    clouds = {"network": COMPLETE, "network_unadapted": COMPLETE}
    scores = score(clouds, MEASURED, COMPLETE, FEW)
    assert list(scores) == ["network_unadapted", "network"]
    assert scores["network_unadapted"] == scores["network"]
    best = scores["network"].named()
    high = {name for name in best if name.startswith(("f_", "precision", "recall"))}
    assert len(high) == 7 and {best.pop(name) for name in high} == {1}
    assert best == pytest.approx(dict.fromkeys(best, 0), abs=1e-12)
    # Nothing is unseen, and nothing was added.
    found = score({"completed": COMPLETE}, COMPLETE, COMPLETE)["completed"]
    assert list(found.named()) == ["cd_l2", "cd_l1", "f_score", "hausdorff"]
