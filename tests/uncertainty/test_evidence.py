"""Evidence for and against completions, on clouds whose answers are known."""

import numpy as np
import pytest

from prism_jax.completion.filtering import select
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.models.config import ModelConfig
from prism_jax.preprocessing.observation import observe
from prism_jax.uncertainty.confidence import EVIDENCE
from prism_jax.uncertainty.evidence import evidence_of

EYE = np.array([0.0, 0.0, 6.0])


def square(count, height=0.0, side=1.0, seed=0):
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-side, side, (count, 2))
    return np.column_stack([flat, np.full(count, height)])


def evidence(points, prediction=None, num_read=128, looks=None, sensor=EYE):
    """Of points and what was predicted, the points themselves unless given.

    The workspace is the points' own box, so that the unit is theirs.
    """
    seen = observe(points, sensor, ModelConfig(margin=1.0))
    read = seen.sampled(num_read)
    unit = np.asarray(seen.partial)
    predicted = unit if prediction is None else seen.workspace.to_unit(prediction)
    eye = np.asarray(seen.eye) if seen.sensor_known else None
    selection = select(predicted, unit, read.partial, eye)
    looks = [IndexedCloud(look) for look in looks or 3 * [predicted]]
    shares = (selection.stray | selection.outside).mean(), selection.in_front.mean()
    return evidence_of(seen, read, predicted, *map(float, shares), looks, novelty=0.5)


def test_of_a_completion_that_adds_nothing():
    points = square(2000)
    found = evidence(points)
    assert list(found) == list(EVIDENCE)
    assert found["num_points"] == 2000
    assert found["novelty"] == 0.5
    for name in ("strays", "in_front", "unexplained", "reach", "looked_through"):
        assert found[name] == 0.0, name
    assert found["disagreement_mirrored"] == found["disagreement_turned"] == 0.0
    assert found["roughness"] < 1e-6
    # Copies are no measurements.
    assert evidence(np.concatenate([points, points]))["num_points"] == 2000


def test_a_share_of_points_that_are_wrong_is_counted():
    points = square(2000)
    in_front = square(500, height=0.8, side=0.5)
    beyond = square(500, height=0.0, side=0.2) + [5.0, 0, 0]
    found = evidence(points, np.concatenate([points[:1000], in_front, beyond]))
    assert found["in_front"] == pytest.approx(0.25)
    assert found["strays"] == pytest.approx(0.25)
    assert found["looked_through"] == pytest.approx(0.25)


def test_roughness_is_the_noise():
    """Across a plane of noise; planes through twelve points take up a part of it."""
    points = square(20_000)
    noisy = points + np.random.default_rng(1).normal(0, 0.005, points.shape) * [0, 0, 1]
    assert 0.0035 < evidence(noisy)["roughness"] < 0.005
    assert evidence(noisy[:12])["roughness"] == 0.0


def test_disagreement_is_the_chamfer_distance_and_reach_a_mean():
    points = square(2000)
    off = points + [0, 0, 0.1]
    found = evidence(points, points - [0, 0, 0.3], looks=(points, off, points))
    assert found["disagreement_mirrored"] == pytest.approx(0.1)
    assert found["disagreement_turned"] == 0.0
    assert found["unexplained"] == pytest.approx(0.3, rel=0.02)
    assert found["reach"] == pytest.approx(0.3, rel=0.02)


def test_few_collinear_and_repeated_points():
    repeated = np.ones((5, 3)) * [[1], [1], [1], [1], [2]]
    for points in (repeated, square(20) * [1, 0, 1]):
        assert np.isfinite(list(evidence(points, sensor=None).values())).all()
