"""Scenes in any frame and unit, completed object by object."""

import dataclasses

import numpy as np
import pytest
import trimesh

from prism_jax.completion import filtering
from prism_jax.completion.assembly import in_one_scene
from prism_jax.geometry.camera import Camera
from prism_jax.io import Scan
from prism_jax.io.errors import InputError
from prism_jax.preprocessing.segmentation.scene import SegmentedScene
from prism_jax.registration.library import Library, Model
from prism_jax.registration.surface import surface_of
from prism_jax.reporting import render_scene_report, summary

EYE = np.array([0.0, -8.0, 6.0])
FAR = np.array([4e5, 5e6, 100.0])
CAMERA = Camera.look_at(EYE, np.zeros(3))
COUNT = 3


def shell(center, seed):
    """What a sensor sees of a box of side 1."""
    rng = np.random.default_rng(seed)
    box = rng.uniform(-1, 1, (300, 3))
    box /= np.abs(box).max(-1, keepdims=True)
    return center + 0.5 * box * np.sign(box @ (EYE - center))[:, None]


@pytest.fixture(scope="module", autouse=True)
def narrow():
    """So few points as this network reads make a rim as wide as the workspace."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(filtering, "PAST", 0.5)
        yield


@pytest.fixture(scope="module")
def scene():
    """Boxes on a table, and which point is whose."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-5, 5, (6000, 3)) * [1, 1, 1e-3]
    places = [np.array([2 * (i % 3) - 2, 2 * (i // 3) - 2, 0.51]) for i in range(COUNT)]
    boxes = [shell(place, i) for i, place in enumerate(places)]
    number = np.repeat(np.arange(COUNT + 1) - 1, [6000, *COUNT * [300]])
    return np.concatenate([table, *boxes]), number


@pytest.fixture(scope="module")
def done(completer, scene):
    """Taken apart by construction."""
    points, number = scene
    taken_apart = SegmentedScene(number, (), COUNT * (300,), 6000, 0)
    return completer.complete_scene(points, CAMERA, up="z", scene=taken_apart)


def test_each_object_is_completed_as_if_it_were_alone(done, completer, scene):
    """Around it lies all that is not its own."""
    points, number = scene
    assert done.points[done.observed].tobytes() == points.tobytes()
    assert np.array_equal(done.observed, np.arange(len(done.points)) < len(points))
    assert np.array_equal(done.object[done.observed], number)
    seen_past = 0
    for i, one in enumerate(done.objects):
        own = number == i
        alone = completer.complete(points[own], CAMERA, around=points[~own])
        np.testing.assert_array_equal(one.prediction, alone.prediction)
        assert one.left_away == alone.left_away
        assert one.accepted == alone.accepted
        assert one.sensor == "given"
        added = done.points[~done.observed & (done.object == i)]
        assert np.array_equal(added, one.points[~one.observed])
        assert np.abs(one.workspace.to_unit(added)).max() <= 1 + 1e-12
        seen_past += one.left_away["looked_through"]
    assert len(done.objects) == COUNT and seen_past > 0


def test_errors_of_points_come_with_their_objects(done, scene):
    """And with all of them, or not at all."""
    points, number = scene
    sigmas = [np.where(x.observed, 0.0, 0.5 + i) for i, x in enumerate(done.objects)]
    pairs = zip(done.objects, sigmas, strict=True)
    objects = [dataclasses.replace(one, sigma=sigma) for one, sigma in pairs]

    def sigma(objects):
        return in_one_scene(points, number, objects, (), np.eye(3)[2], "z").sigma

    expected = np.where(done.observed, 0.0, 0.5 + done.object)
    np.testing.assert_array_equal(sigma(objects), expected)
    assert done.sigma is sigma([*objects[:-1], done.objects[-1]]) is None
    assert not sigma([]).any() and len(sigma([])) == len(points)


def test_it_takes_the_scene_apart_itself(completer, scene):
    """Far from the origin, with the table's normal as the way up."""
    points, number = scene
    there = Camera.look_at(EYE + FAR, FAR)
    found = completer.complete_scene(points + FAR, there)
    np.testing.assert_allclose(found.up, [0, 0, 1], atol=0.01)
    assert found.up_source == "support" and len(found.planes) == 1
    assert len(found.objects) == COUNT
    whose = found.object[found.observed]
    assert (whose[number == -1] == -1).mean() > 0.99
    for i in range(COUNT):
        assert np.bincount(whose[number == i] + 2).max() > 0.9 * 300
    table = completer.complete_scene(points[:6000], CAMERA)
    assert table.objects == () and table.observed.all()
    assert table.points.tobytes() == points[:6000].tobytes()
    with pytest.raises(InputError, match="at least 64"):
        completer.complete_scene(points[:50], CAMERA)


def test_two_known_boxes_and_a_strange_thing(completer, scene):
    """The boxes come back as the model, the thing as the network completes it."""
    points, number = (rows[scene[1] < 3].copy() for rows in scene)
    for i in range(3):
        # Its top and its front, which are all that is seen.
        sides = np.random.default_rng(i).uniform(-0.5, 0.5, (300, 3))
        sides[:150, 1], sides[150:, 2] = -0.5, 0.5
        points[number == i] = sides + [2 * i - 2, -2, 0.51]
    half = (number == 2) & (points[:, 2] > 0.7)
    points[half] = points[half] * [0.6, 0.6, 2.0] + [0.9, -0.8, 0.0]
    taken_apart = SegmentedScene(number, (), 3 * (300,), 6000, 0)
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    own = np.asarray(box.vertices), np.asarray(box.faces)
    knowing = completer.knowing(Library([Model("box", *own, surface_of(*own))]))
    given = {"up": "z", "scene": taken_apart}
    found = knowing.complete_scene(points, CAMERA, **given)
    plain = completer.complete_scene(points, CAMERA, **given)
    assert found.points[found.observed].tobytes() == points.tobytes()
    for i, (one, other) in enumerate(zip(found.objects, plain.objects, strict=True)):
        assert other.known is None and one.known is not None
        added = found.points[(found.object == i) & ~found.observed]
        labels = found.label[(found.object == i) & ~found.observed]
        if i == 2:
            assert one.known.model is None and list(one.known.refused) == ["box"]
            assert set(labels) == {1} and np.array_equal(one.points, other.points)
            continue
        assert one.known.model.name == "box" and set(labels) == {2}
        center = [2 * i - 2, -2, 0.51]
        np.testing.assert_allclose(np.abs(added - center).max(axis=1), 0.5, atol=0.02)
        assert one.verdict.trust == "fair" and "unnoticed" in one.verdict.reasons[0]
        assert one.sigma[~one.observed].min() > 0
    asked = {"weights": "small", "up": "z", "bounds": None, "density": 1.0}
    told = summary.summarize_scene(
        found, Scan(points, None, 0, 0), "scan", **asked, adapt=False
    )
    page = render_scene_report(found, summary.plain(told | {"seconds": {"run": 1.0}}))
    assert page.count("known: box") == 2
