import numpy as np
import pytest
import trimesh

from prism_jax.data.partials import (
    farthest_point_order,
    random_viewpoint,
    visible_points,
)


def two_boxes() -> trimesh.Trimesh:
    near = trimesh.creation.box((0.5, 0.5, 0.5)).apply_translation((0, -0.7, 0))
    far = trimesh.creation.box((0.8, 0.5, 0.8)).apply_translation((0, 0.7, 0))
    return trimesh.util.concatenate([near, far])


def test_points_lie_on_the_surface_and_see_the_camera():
    mesh, eye = two_boxes(), np.array([0.3, -3.0, 0.5])
    points = visible_points(mesh, eye)
    assert len(points) >= 2048
    chosen = points[::60]
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, chosen)
    assert distance.max() < 1e-6
    for point in chosen:
        assert not _blocked(mesh.triangles, eye, point)


def _blocked(triangles: np.ndarray, eye: np.ndarray, point: np.ndarray) -> bool:
    """Moeller-Trumbore: is a triangle crossed clearly before the point?"""
    direction = point - eye
    first, second = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
    normal = np.cross(direction, second)
    scale = np.sum(first * normal, axis=1)
    safe = np.where(np.abs(scale) < 1e-12, np.nan, scale)
    offset = eye - triangles[:, 0]
    u = np.sum(offset * normal, axis=1) / safe
    other = np.cross(offset, first)
    v, t = other @ direction / safe, np.sum(second * other, axis=1) / safe
    return bool(np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-5)))


def test_sphere_shows_its_cap_only():
    """A sphere of radius r at distance d shows cos(angle) >= r / d."""
    sphere, eye = trimesh.creation.icosphere(4), np.array([0.0, 3.0, 0.0])
    cosine = visible_points(sphere, eye) @ eye / 3.0
    assert cosine.min() == pytest.approx(1 / 3, abs=0.02)


def test_slender_object_gets_more_rays():
    needle = trimesh.creation.box((0.01, 2.0, 0.01))
    needle.apply_transform(trimesh.transformations.rotation_matrix(0.8, (1, 0, 0)))
    assert len(visible_points(needle, np.array([3.0, 0.5, 0.0]))) >= 2048


def test_camera_straight_above_is_fine_and_camera_inside_is_not():
    mesh = trimesh.creation.box((1, 1, 1))
    points = visible_points(mesh, np.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(points[:, 2], 0.5, atol=1e-6)
    with pytest.raises(ValueError, match="inside"):
        visible_points(mesh, np.array([0.1, 0.0, 0.0]))


def test_far_from_the_origin_the_view_is_the_same():
    shift = np.array([512.0, -256.0, 128.0])
    mesh, eye = two_boxes(), np.array([1.0, -3.0, 0.5])
    moved = visible_points(mesh.copy().apply_translation(shift), eye + shift)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, moved[::60] - shift)
    assert len(moved) >= 2048
    assert distance.max() < 1e-6


def greedy_order(points: np.ndarray, start: int, count: int) -> list[float]:
    """Covering radius before each step of a plain farthest-point loop."""
    gaps = np.sum((points - points[start]) ** 2, axis=1)
    radii = []
    for _ in range(count - 1):
        winner = int(np.argmax(gaps))
        radii.append(gaps[winner])
        gaps = np.minimum(gaps, np.sum((points - points[winner]) ** 2, axis=1))
    return radii


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_order_is_exactly_farthest_point(offset):
    """Against a NumPy loop from the same first point."""
    points = np.random.default_rng(0).normal(size=(3000, 3)).astype(np.float32)
    points = points * np.float32([1, 0.3, 0.1]) + np.float32(offset)
    order = farthest_point_order(points, 300)
    start = int(np.argmax(np.all(points == order[0], axis=1)))
    expected = greedy_order(points, start, 300)
    gaps = np.sum((points - order[0]) ** 2, axis=1)
    for step, radius in enumerate(expected, 1):
        chosen = np.sum((order[:step] - order[step]) ** 2, axis=1).min()
        assert chosen == pytest.approx(gaps.max(), rel=1e-6)
        assert chosen == pytest.approx(radius, rel=1e-6)
        gaps = np.minimum(gaps, np.sum((points - order[step]) ** 2, axis=1))


def test_short_clouds_repeat_cyclically_and_empty_ones_raise():
    points = np.random.default_rng(1).normal(size=(5, 3))
    order = farthest_point_order(points, 12)
    np.testing.assert_array_equal(order[5:10], order[:5])
    assert len(np.unique(order, axis=0)) == 5
    one = farthest_point_order(points[:1], 3)
    np.testing.assert_array_equal(one, np.repeat(points[:1], 3, axis=0))
    with pytest.raises(ValueError, match="empty"):
        farthest_point_order(points[:0], 3)


def test_duplicates_come_last():
    points = np.random.default_rng(2).normal(size=(50, 3))
    order = farthest_point_order(np.tile(points, (4, 1)), 50)
    assert len(np.unique(order, axis=0)) == 50


def test_viewpoints_stay_in_their_ranges():
    rng = np.random.default_rng(3)
    eyes = np.array([random_viewpoint(rng) for _ in range(300)])
    distance = np.linalg.norm(eyes, axis=1)
    elevation = np.degrees(np.arcsin(eyes[:, 2] / distance))
    assert 2.5 <= distance.min() < 2.6 and 3.9 < distance.max() <= 4.0
    assert -10 <= elevation.min() < -7 and 57 < elevation.max() <= 60
    octants = np.arctan2(eyes[:, 1], eyes[:, 0]) // (np.pi / 4)
    assert len(np.unique(octants)) == 8
