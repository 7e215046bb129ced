"""Scenes in any frame and unit, completed object by object."""

import dataclasses

import numpy as np
import pytest

from prism_jax.completion import completer as completion
from prism_jax.completion.assembly import in_one_scene
from prism_jax.completion.completer import Completer
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError
from prism_jax.preprocessing.segmentation.scene import SegmentedScene

EYE = np.array([0.0, -8.0, 6.0])
FAR = np.array([4e5, 5e6, 100.0])


def shell(center, side, seed):
    """What a sensor sees of a box."""
    rng = np.random.default_rng(seed)
    box = rng.uniform(-1, 1, (300, 3))
    box /= np.abs(box).max(-1, keepdims=True)
    return center + 0.5 * side * box * np.sign(box @ (EYE - center))[:, None]


@pytest.fixture(scope="module")
def scene():
    """Three boxes on a table, and which point is whose."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-3, 3, (4000, 3)) * [1, 1, 1e-3]
    boxes = [shell(np.array([x, 0, 0.51]), 1.0, i) for i, x in enumerate((-2, 0, 2))]
    number = np.repeat([-1, 0, 1, 2], [4000, 300, 300, 300])
    return np.concatenate([table, *boxes]), number


@pytest.fixture(scope="module")
def completer(minimal, minimal_variables):
    return Completer(minimal.config, minimal_variables)


@pytest.fixture(scope="module")
def taken_apart(scene):
    """By construction, so that this file tests the completion alone."""
    _, number = scene
    return SegmentedScene(number, (), (300, 300, 300), 4000, 0)


@pytest.fixture(scope="module")
def camera():
    return Camera.look_at(EYE, np.zeros(3))


@pytest.fixture(scope="module")
def done(completer, scene, taken_apart, camera):
    return completer.complete_scene(scene[0], camera, up="z", scene=taken_apart)


def test_measured_points_come_first_and_as_given(done, scene):
    points, number = scene
    assert done.points[done.observed].tobytes() == points.tobytes()
    assert np.array_equal(done.observed, np.arange(len(done.points)) < len(points))
    assert np.array_equal(done.object[done.observed], number)


def test_each_object_is_completed_as_if_it_were_alone(
    done, completer, scene, taken_apart, camera
):
    points, number = scene
    for i, one in enumerate(done.objects):
        alone = completer.complete(points[number == i], camera)
        np.testing.assert_allclose(one.prediction, alone.prediction, atol=1e-4)
        assert one.accepted == alone.accepted
        assert one.sensor == "given"
        added = done.points[~done.observed & (done.object == i)]
        assert np.array_equal(added, one.points[~one.observed])
        assert np.abs(one.workspace.to_unit(added)).max() <= 1


def test_errors_of_points_come_with_their_objects(done, scene):
    """And with all of them, or not at all."""
    assert done.sigma is None
    points, number = scene
    objects = [
        dataclasses.replace(one, sigma=np.where(one.observed, 0.0, 0.5 + i))
        for i, one in enumerate(done.objects)
    ]

    def sigma(objects):
        put = in_one_scene(points, number, objects, (), np.array([0, 0, 1.0]), "z")
        return put.sigma

    told = sigma(objects)
    expected = np.where(done.observed, 0.0, 0.5 + done.object)
    np.testing.assert_array_equal(told, expected)
    assert sigma([*objects[:2], done.objects[2]]) is None
    assert not sigma([]).any() and len(sigma([])) == len(points)


def test_more_objects_than_slots(completer, scene, taken_apart, camera, monkeypatch):
    """In several calls; the empty slots of the last change nothing."""
    whole = completer.complete_scene(scene[0], camera, up="z", scene=taken_apart)
    monkeypatch.setattr(completion, "SLOTS", 2)
    own = Completer(completer.config, completer.variables)
    again = own.complete_scene(scene[0], camera, up="z", scene=taken_apart)
    assert len(again.objects) == 3
    np.testing.assert_allclose(again.points, whole.points, atol=1e-4)


def test_it_takes_the_scene_apart_itself(completer, scene, camera):
    """Far from the origin, with the table's normal as the way up."""
    points, number = scene
    there = Camera.look_at(EYE + FAR, FAR)
    found = completer.complete_scene(points + FAR, there)
    np.testing.assert_allclose(found.up, [0, 0, 1], atol=0.01)
    assert found.up_source == "support" and len(found.planes) == 1
    assert len(found.objects) == 3
    whose = found.object[found.observed]
    assert (whose[number == -1] == -1).mean() > 0.99
    for i in range(3):
        assert np.bincount(whose[number == i] + 2).max() > 0.9 * 300


def test_a_scene_without_objects(completer, scene, camera):
    table = scene[0][:4000]
    done = completer.complete_scene(table, camera)
    assert done.objects == ()
    assert done.points.tobytes() == table.tobytes() and done.observed.all()


def test_what_cannot_be_completed_is_refused(completer, scene, camera):
    points, _ = scene
    with pytest.raises(InputError, match="at least 64"):
        completer.complete_scene(points[:50], camera)
    with pytest.raises(InputError, match="density"):
        completer.complete_scene(points, camera, density=-1.0)
    with pytest.raises(InputError, match="up=w"):
        completer.complete_scene(points, camera, up="w")
