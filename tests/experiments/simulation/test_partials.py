import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from experiments.simulation.partials import (
    HALF_EXTENT,
    l515,
    make_partial,
    ouster,
    self_occlusion,
    sparse,
)
from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.sensors import (
    L515Config,
    OusterConfig,
)
from tests.experiments.simulation.test_raycast import moeller_trumbore


def two_boxes() -> trimesh.Trimesh:
    near = trimesh.creation.box((0.5, 0.5, 0.5)).apply_translation((0, -0.7, 0))
    far = trimesh.creation.box((0.8, 0.5, 0.8)).apply_translation((0, 0.7, 0))
    return trimesh.util.concatenate([near, far])


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two boxes in the frame of stored examples."""
    mesh = two_boxes()
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return Scene(mesh.apply_scale(2 / mesh.extents.max()))


@pytest.fixture(scope="module")
def complete(scene) -> np.ndarray:
    return sample_outside(scene, 4000, np.random.default_rng(0))


def test_points_lie_on_the_surface_and_see_the_camera():
    mesh, eye = two_boxes(), np.array([0.3, -3.0, 0.5])
    points = self_occlusion(Scene(mesh), eye)
    assert len(points) >= 2048
    chosen = points[::60]
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, chosen)
    assert distance.max() < 1e-6
    first, _ = moeller_trumbore(
        mesh.triangles, np.tile(eye, (len(chosen), 1)), chosen - eye
    )
    np.testing.assert_allclose(first, np.linalg.norm(chosen - eye, axis=1), atol=1e-6)


def test_sphere_shows_its_cap_only():
    """A sphere of radius r at distance d shows cos(angle) >= r / d."""
    sphere, eye = Scene(trimesh.creation.icosphere(4)), np.array([0.0, 3.0, 0.0])
    cosine = self_occlusion(sphere, eye) @ eye / 3.0
    assert cosine.min() == pytest.approx(1 / 3, abs=0.02)


def test_slender_object_gets_more_rays():
    needle = trimesh.creation.box((0.01, 2.0, 0.01))
    needle.apply_transform(trimesh.transformations.rotation_matrix(0.8, (1, 0, 0)))
    assert len(self_occlusion(Scene(needle), np.array([3.0, 0.5, 0.0]))) >= 2048


def test_camera_straight_above_is_fine_and_camera_inside_is_not():
    box = Scene(trimesh.creation.box((1, 1, 1)))
    points = self_occlusion(box, np.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(points[:, 2], 0.5, atol=1e-6)
    inside, rng = np.array([0.1, 0.0, 0.0]), np.random.default_rng(0)
    with pytest.raises(ValueError, match="inside"):
        self_occlusion(box, inside)
    for view in (sparse, l515, ouster):
        with pytest.raises(ValueError, match="inside"):
            view(box, inside, rng)


def test_random_crops_span_the_published_shares_from_the_unit_sphere(scene, complete):
    rng = np.random.default_rng(1)
    made = [make_partial("crop", scene, complete, rng, 2048) for _ in range(60)]
    counts = np.array([len(points) for points, _ in made])
    assert 1000 <= counts.min() < 1200 and 2800 < counts.max() <= 3000
    eyes = np.array([eye for _, eye in made])
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 1, rtol=1e-12)
    assert np.all(np.abs(eyes.mean(axis=0)) < 4 / np.sqrt(3 * 60))


@pytest.mark.parametrize(
    ("view", "config", "allowed"),
    [(l515, L515Config(), 0.00025), (ouster, OusterConfig(), 0.001)],
)
def test_exact_sensors_measure_the_near_side(scene, view, config, allowed):
    eye = np.array([1.8, -2.0, 1.5])
    points = view(scene, eye, np.random.default_rng(4), config.exact())
    chosen = points[:: len(points) // 40]
    first, _ = moeller_trumbore(
        scene.triangles, np.tile(eye, (len(chosen), 1)), chosen - eye
    )
    error = np.linalg.norm(chosen - eye, axis=1) - first
    assert np.abs(error).max() <= allowed / HALF_EXTENT
    assert len(np.unique(points, axis=0)) == len(points) > 2048
    seen = self_occlusion(scene, eye)
    assert KDTree(points).query(seen)[0].max() < 0.06
