import numpy as np
import pytest
import trimesh

from experiments.simulation.partials import make_partial, self_occlusion
from experiments.simulation.raycast import Scene, sample_outside


def test_sphere_shows_its_cap_only():
    """A sphere of radius r at distance d shows cos(angle) >= r / d."""
    sphere, eye = Scene(trimesh.creation.icosphere(4)), np.array([0.0, 3.0, 0.0])
    points = self_occlusion(sphere, eye)
    assert (points @ eye / 3.0).min() == pytest.approx(1 / 3, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=0.01)


def test_random_crops_span_the_published_shares_from_the_unit_sphere():
    scene, rng = Scene(trimesh.creation.box((1, 2, 1))), np.random.default_rng(1)
    complete = sample_outside(scene, 400, rng)
    made = [make_partial("crop", scene, complete, rng, 2048) for _ in range(60)]
    counts = np.array([len(points) for points, _ in made])
    assert 100 <= counts.min() < 120 and 280 < counts.max() <= 300
    eyes = np.array([eye for _, eye in made])
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 1, rtol=1e-12)
    assert np.all(np.abs(eyes.mean(axis=0)) < 4 / np.sqrt(3 * 60))
