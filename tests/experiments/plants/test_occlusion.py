"""Virtual occlusion: what it hides, how much, and from where."""

import numpy as np
import pytest

from experiments.plants import occlusion
from experiments.plants.occlusion import HIDDEN_SHARES, TURNS, occluded, seen_from

EYE = np.array([3.0, -4.0, 2.5])
RNG = np.random.default_rng(0)
CLOUD = RNG.uniform(-1, 1, (500, 3)) * [1.0, 0.5, 0.7]


def sorted_rows(points):
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("seed", range(12))
def test_a_cloud_is_parted(seed):
    found = occluded(CLOUD, EYE, np.random.default_rng(seed))
    both = np.concatenate([found.kept, found.hidden])
    np.testing.assert_array_equal(sorted_rows(both), sorted_rows(CLOUD))
    share = len(found.hidden) / len(CLOUD)
    assert HIDDEN_SHARES[0] <= share <= HIDDEN_SHARES[1]
    again = occluded(CLOUD, EYE, np.random.default_rng(seed))
    np.testing.assert_array_equal(again.kept, found.kept)
    distance = np.linalg.norm([found.eye, EYE], axis=1)
    assert np.isclose(*distance, rtol=0.1)


def test_what_lies_behind_is_hidden_from_either_side():
    """Two plates, the near one covering the far one's lower half."""
    x, z = np.meshgrid(np.linspace(-1, 1, 30), np.linspace(0, 1, 16))
    near = np.stack([x, np.zeros_like(x), 0.5 * z], -1).reshape(-1, 3)
    far = np.stack([x, np.ones_like(x), z], -1).reshape(-1, 3)
    cloud = np.concatenate([near, far])
    front = seen_from(cloud, np.array([0.0, -40.0, 0.25]))
    assert front[: len(near)].all()
    lower, upper = far[:, 2] < 0.42, far[:, 2] > 0.65
    assert not front[len(near) :][lower & (np.abs(far[:, 0]) < 0.9)].any()
    assert front[len(near) :][upper].all()
    back = seen_from(cloud, np.array([0.0, 40.0, 0.25]))
    assert back[len(near) :].all()
    assert back[: len(near)].mean() < 0.2


def test_a_thing_in_the_way_leaves_what_it_does_not_touch(monkeypatch):
    """A plate before the points with x > 0."""
    import trimesh

    from experiments.simulation.raycast import Scene

    plate = trimesh.creation.box(bounds=[(0.0, -5.01, -9), (9.0, -5.0, 9)])
    monkeypatch.setattr(occlusion, "random_occluder", lambda *_: Scene(plate))
    eye = np.array([0.0, -10.0, 0.0])
    kept, place = occlusion._behind_something(CLOUD, eye, RNG)
    np.testing.assert_array_equal(kept, CLOUD[:, 0] < 0)
    np.testing.assert_array_equal(place, eye)
    monkeypatch.setattr(occlusion, "random_occluder", lambda *_: None)
    assert occlusion._behind_something(CLOUD, eye, RNG)[0].all()


def test_a_second_sensor_stands_as_high_and_as_far():
    kept, place = occlusion._seen_from_elsewhere(CLOUD, EYE, np.random.default_rng(0))
    assert 0 < kept.mean() < 1
    assert np.isclose(place[2], EYE[2])
    middle = 0.5 * (CLOUD.min(0) + CLOUD.max(0))
    one, other = ((each - middle)[:2] for each in (EYE, place))
    assert np.isclose(*np.linalg.norm([one, other], axis=1))
    cosine = one @ other / np.linalg.norm(one) ** 2
    assert TURNS[0] <= np.degrees(np.arccos(cosine)) <= TURNS[1]


def test_without_a_sensor_the_nearest_points_go():
    found = occluded(CLOUD, None, np.random.default_rng(0))
    assert found.eye is None
    assert len(found.kept) + len(found.hidden) == len(CLOUD)
    assert 0.2 < len(found.hidden) / len(CLOUD) < 0.8


@pytest.mark.parametrize("count", (4, 70))
def test_few_points_and_flat_clouds_are_parted(count):
    flat = np.concatenate([CLOUD[:count, :2], np.zeros((count, 1))], axis=1)
    for seed in range(6):
        found = occluded(flat, EYE, np.random.default_rng(seed))
        assert len(found.kept) and len(found.hidden)


def test_next_to_nothing_is_refused():
    with pytest.raises(ValueError, match="too few"):
        occluded(CLOUD[:3], EYE, RNG)
