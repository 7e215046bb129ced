"""All clouds of an example at once, against the metrics one by one."""

import numpy as np
import pytest

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
    scores = score(clouds, COMPLETE, FEW)
    assert tuple(scores) == CLOUDS
    for name, cloud in clouds.items():
        few = farthest_point_order(cloud, EMD_POINTS)
        expected = metrics.score(cloud, COMPLETE)
        expected = expected._replace(emd=metrics.emd(few, FEW))
        assert scores[name] == pytest.approx(expected, rel=1e-12), name


def test_the_right_answer_is_the_best_there_is():
    """Under one name or two. Only what is there is scored."""
    clouds = {"network": COMPLETE, "network_unadapted": COMPLETE}
    scores = score(clouds, COMPLETE, FEW)
    assert list(scores) == ["network_unadapted", "network"]
    assert scores["network_unadapted"] == scores["network"]
    best = scores["network"].named()
    assert best.pop("f_score") == 1
    assert best == pytest.approx(dict.fromkeys(best, 0), abs=1e-12)
    assert score({"network": COMPLETE}, COMPLETE)["network"].emd is None
