"""What befalls partials when they are read."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.data.augmentation import Augmentation, augmented
from prism_jax.data.source import Example
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import SURFACE, UNKNOWN, Visibility, look_up
from prism_jax.io.errors import InputError

EYE = np.array([0.0, -4.0, 1.0], np.float32)


@pytest.fixture(scope="module")
def example() -> Example:
    """The visible half of a ball, and a map in which every point has its pixel."""
    rng = np.random.default_rng(0)
    complete = rng.normal(size=(3000, 3))
    complete /= np.linalg.norm(complete, axis=1, keepdims=True)
    partial = complete[complete @ EYE > 1.2].astype(np.float32)
    focal = 16 / 0.35
    camera = Camera(
        rotation=np.array(Camera.look_at(EYE, (0, 0, 0)).rotation),
        translation=np.zeros(3, np.float32),
        intrinsics=np.array([(focal, 0, 15.5), (0, focal, 15.5), (0, 0, 1)]),
        height=32,
        width=32,
    )
    camera.translation[:] = -camera.rotation @ EYE
    pixel, depth = camera.pixel_of(partial)
    state, depths = np.zeros(1024, np.uint8), np.zeros(1024, np.float32)
    state[pixel], depths[pixel] = SURFACE, depth
    known = Visibility(camera, state.reshape(32, 32), depths.reshape(32, 32))
    return Example(
        complete.astype(np.float32), partial, EYE, "ball", "0", True, visibility=known
    )


def subset(few: np.ndarray, many: np.ndarray) -> np.ndarray:
    """Places of the few among the many."""
    gaps, places = KDTree(many).query(few)
    np.testing.assert_array_equal(gaps, 0)
    return places


def test_nothing_happens_unless_asked_for(example):
    found = augmented(example, Augmentation(), np.random.default_rng(0))
    np.testing.assert_array_equal(found.partial, example.partial)
    assert found.visibility is example.visibility


def test_a_crop_takes_a_half_space_and_its_surface_is_forgotten(example):
    settings = Augmentation(crop=1.0, crop_shares=(0.2, 0.5))
    shares, normals = [], []
    for seed in range(40):
        found = augmented(example, settings, np.random.default_rng(seed))
        places = subset(found.partial, example.partial)
        assert np.all(np.diff(places) > 0)
        shares.append(1 - len(places) / len(example.partial))
        gone = np.delete(example.partial, places, axis=0)
        between = gone.mean(axis=0) - found.partial.mean(axis=0)
        normals.append(between / np.linalg.norm(between))
        kept, _ = look_up(found.visibility, found.partial)
        lost, _ = look_up(found.visibility, gone)
        assert np.mean(kept == SURFACE) > 0.85
        assert np.mean(lost == UNKNOWN) > 0.85
        assert np.all((found.visibility.depth > 0) == (found.visibility.state > 0))
        np.testing.assert_array_equal(found.complete, example.complete)
    assert 0.19 < min(shares) < 0.25 and 0.45 < max(shares) < 0.51
    assert np.linalg.norm(np.mean(normals, axis=0)) < 0.6


def test_of_one_pixel_each_point_is_forgotten_exactly_beyond_the_plane():
    """Where no two points share a pixel."""
    eye = np.array([0.0, 0, -3], np.float32)
    camera = Camera(
        rotation=np.eye(3, dtype=np.float32),
        translation=-eye,
        intrinsics=np.array([(20, 0, 9.5), (0, 20, 9.5), (0, 0, 1)], np.float32),
        height=20,
        width=20,
    )
    rows, columns = np.indices((20, 20)).reshape(2, -1)
    rng = np.random.default_rng(1)
    depth = rng.uniform(2, 4, 400)
    rays = np.stack([columns - 9.5, rows - 9.5, np.full(400, 20.0)], -1) / 20
    points = (eye + rays * depth[:, None]).astype(np.float32)
    state = np.full((20, 20), SURFACE, np.uint8)
    known = Visibility(camera, state, depth.reshape(20, 20).astype(np.float32))
    example = Example(points, points, eye, "", "0", visibility=known)
    for seed in range(10):
        settings = Augmentation(crop=1.0)
        found = augmented(example, settings, np.random.default_rng(seed))
        kept = np.zeros(400, bool)
        kept[subset(found.partial, points)] = True
        wrong = (found.visibility.state.ravel() == SURFACE) != kept
        assert wrong.sum() <= 1


def test_thinning_leaves_any_number_down_to_the_fewest_in_their_order(example):
    settings = Augmentation(thin=0.5, fewest=50)
    counts = []
    for seed in range(60):
        found = augmented(example, settings, np.random.default_rng(seed))
        places = subset(found.partial, example.partial)
        assert np.all(np.diff(places) > 0)
        counts.append(len(places))
    whole = np.array(counts) == len(example.partial)
    assert 0.3 < whole.mean() < 0.7
    assert 50 <= min(counts) < 80
    assert np.median(np.array(counts)[~whole]) < 0.6 * len(example.partial)
    few = example._replace(partial=example.partial[:40])
    found = augmented(few, Augmentation(thin=1.0, fewest=50), np.random.default_rng(0))
    assert len(found.partial) == 40


def test_jitter_is_in_sides_of_the_partial(example):
    far = example._replace(partial=example.partial * 100)
    for given, unit in ((example, 1.0), (far, 100.0)):
        deviations = []
        for seed in range(30):
            rng = np.random.default_rng(seed)
            found = augmented(given, Augmentation(jitter=0.02), rng)
            assert found.partial.dtype == np.float32
            deviations.append(np.std(found.partial - given.partial) / unit)
        side = np.ptp(example.partial, axis=0).max()
        assert max(deviations) == pytest.approx(0.02 * side, rel=0.1)
        assert min(deviations) < 0.005 * side


def test_the_same_generator_does_the_same_and_the_example_stays(example):
    settings = Augmentation(crop=0.5, thin=0.5, jitter=0.01)
    before = example.partial.copy(), example.visibility.state.copy()
    for seed in range(5):
        one, two = (
            augmented(example, settings, np.random.default_rng(seed)) for _ in "ab"
        )
        np.testing.assert_array_equal(one.partial, two.partial)
    np.testing.assert_array_equal(example.partial, before[0])
    np.testing.assert_array_equal(example.visibility.state, before[1])


def test_a_point_alone_stays_and_without_a_partial_there_is_nothing_to_change(example):
    settings = Augmentation(crop=1.0, thin=1.0, fewest=1, jitter=0.1)
    alone = example._replace(partial=example.partial[:1], visibility=None)
    found = augmented(alone, settings, np.random.default_rng(0))
    np.testing.assert_array_equal(found.partial, alone.partial)
    assert found.visibility is None
    with pytest.raises(ValueError, match="0 has no partial"):
        augmented(example._replace(partial=None), settings, np.random.default_rng(0))


@pytest.mark.parametrize(
    "setting",
    [
        {"crop": 1.5},
        {"thin": -0.1},
        {"crop_shares": (0.5, 0.2)},
        {"crop_shares": (0.5, 1.0)},
        {"fewest": 0},
        {"jitter": -1.0},
        {"jitter": float("nan")},
    ],
)
def test_settings_without_sense_are_refused(setting):
    with pytest.raises(InputError):
        Augmentation(**setting)
