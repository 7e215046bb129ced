"""Scenes of known objects, seen by a depth camera, taken apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_jax.io.errors import InputError
from prism_jax.io.pcd import read_pcd
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT, split_scene
from prism_jax.preprocessing.segmentation.support import find_up, tilt_of
from prism_jax.preprocessing.upright import AUTO

EYE = np.array([0.1, -1.2, 0.9])
TURN = Rotation.from_rotvec([0.5, -0.3, 0.2]).as_matrix()


def sphere(center, radius):
    def hit(eye, rays):
        b, c = rays @ (eye - center), (eye - center) @ (eye - center) - radius**2
        root = b * b - c
        return np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), np.inf)

    return hit


def box(center, size, degrees=0.0):
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()

    def hit(eye, rays):
        start, along = (eye - center) @ turn, rays @ turn
        with np.errstate(divide="ignore"):
            one, other = ((s * np.asarray(size) / 2 - start) / along for s in (-1, 1))
        near = np.minimum(one, other).max(axis=1)
        far = np.maximum(one, other).min(axis=1)
        return np.where((near <= far) & (near > 0), near, np.inf)

    return hit


def table(size):
    return box([0, 0, -0.001], [*size, 0.002])


def seen(things, eye=EYE, shape=(120, 160), noise=0.001, seed=0):
    """Points of a depth camera that looks at the origin, and which thing each is of."""
    rng = np.random.default_rng(seed)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rows, columns = np.indices(shape).reshape(2, -1)
    across = (columns - shape[1] / 2) / shape[1]
    down = (rows - shape[0] / 2) / shape[1]
    rays = forward + np.outer(across, right) + np.outer(down, np.cross(forward, right))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return measured(things, eye, rays, noise, rng)


def measured(things, eye, rays, noise, rng, farthest=np.inf):
    ranges = np.stack([thing(eye, rays) for thing in things])
    nearest = ranges.min(axis=0)
    hit = nearest < farthest
    noisy = nearest[hit] + noise * rng.normal(size=hit.sum())
    return eye + noisy[:, None] * rays[hit], ranges.argmin(axis=0)[hit]


def overlaps(labels, found, first=1):
    """For each true object, from label `first`, the best intersection over union."""
    return [
        max(
            ((found == number) & (labels == label)).sum()
            / ((found == number) | (labels == label)).sum()
            for number in range(max(found.max() + 1, 1))
        )
        for label in range(first, labels.max() + 1)
    ]


THINGS = [
    table([1.4, 1.2]),
    box([-0.35, 0.05, 0.1], [0.15, 0.2, 0.2], 30),
    box([0.0, 0.15, 0.12], [0.1, 0.1, 0.24], 45),
    sphere([0.3, -0.1, 0.08], 0.08),
    box([0.1, -0.25, 0.03], [0.12, 0.08, 0.06], 70),
]


@pytest.fixture(scope="module")
def tabletop():
    points, labels = seen(THINGS)
    return points, labels, split_scene(points, "z", EYE)


def test_a_tabletop(tabletop):
    """Tilted, in millimetres and far from the origin."""
    points, labels, _ = tabletop
    origin = np.array([5e5, 5.4e6, 300])
    points, eye = 1000 * points @ TURN.T + origin, 1000 * TURN @ EYE + origin
    scene = split_scene(points, find_up(points, eye).vector, eye)
    assert len(scene.num_points) == 4
    assert min(overlaps(labels, scene.object)) > 0.85
    assert ((scene.object == SUPPORT) == (labels == 0)).mean() > 0.98
    assert len(scene.planes) == 1
    assert scene.planes[0].normal @ TURN @ [0, 0, 1] > 0.9999
    assert scene.planes[0].tolerance == pytest.approx(1000 * 0.003, rel=0.6)


def test_the_sensor_need_not_be_known_and_duplicates_change_nothing(tabletop):
    points, labels, _ = tabletop
    once, twice = split_scene(points), split_scene(np.tile(points, (2, 1)))
    assert min(overlaps(labels, once.object)) > 0.85
    assert tilt_of(once.planes, [0, 0.6, 0.8]) == pytest.approx(36.9, abs=0.5)
    assert tilt_of(once.planes, "y") == tilt_of(once.planes, AUTO) == 0.0
    assert len(twice.num_points) == 4
    assert np.array_equal(twice.object[: len(points)], twice.object[len(points) :])
    nowhere = split_scene(points, "z", np.full(3, np.nan))
    assert np.array_equal(nowhere.object, once.object)


def test_near_and_far_objects():
    """A street: the points of the farthest are ten times as far apart."""
    eye = np.array([0, 0, 2.0])
    rng = np.random.default_rng(0)
    azimuth = np.deg2rad(np.arange(-40, 40, 0.25))
    elevation = np.deg2rad(np.arange(-28, 2, 0.4))
    a, e = np.meshgrid(azimuth, elevation)
    rays = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=-1)
    rays = rays.reshape(-1, 3)
    things = [box([50, 0, -0.5], [100, 100, 1])]
    for distance, side in [(8, -2), (15, 4), (25, -6), (35, 5)]:
        things.append(box([distance, side, 0.8], [4, 1.8, 1.6]))
    points, labels = measured(things, eye, rays, 0.01, rng, 60)
    scene = split_scene(points, "z", eye)
    assert len(scene.num_points) == 4
    assert min(overlaps(labels, scene.object)) > 0.85


def test_things_that_touch_meet_in_a_crease():
    left = box([-0.1, -0.05, 0.1], [0.2, 0.2, 0.2], 10)
    right = box([0.15, 0, 0.15], [0.2, 0.2, 0.3], -25)
    points, labels = seen([table([1.2, 1.2]), left, right])
    found = split_scene(points, "z", EYE).object
    assert min(overlaps(labels, found)) > 0.8


def test_a_thing_of_several_parts_is_one():
    """A stool: of its legs and its seat some hide parts of the others."""
    legs = [
        box([x, y, 0.15], [0.03, 0.03, 0.3]) for x in (-0.1, 0.1) for y in (-0.1, 0.1)
    ]
    seat = box([0, 0, 0.31], [0.3, 0.3, 0.02])
    points, labels = seen([table([1.4, 1.2]), *legs, seat])
    scene = split_scene(points, "z", EYE)
    assert len(scene.num_points) == 1
    assert overlaps(np.minimum(labels, 1), scene.object)[0] > 0.85


def test_a_shelf_is_one_thing_though_it_has_a_back_and_sides():
    """A side is no support of what stands between it and the other."""
    panels = [
        box([0, 0.25, 0.4], [0.4, 0.02, 0.8]),
        *(box([x, 0, 0.4], [0.02, 0.5, 0.8]) for x in (-0.19, 0.19)),
        *(box([0, 0, z], [0.36, 0.5, 0.02]) for z in (0.01, 0.79)),
    ]
    points, _ = seen(panels)
    scene = split_scene(points, "z", EYE)
    assert (scene.planes, len(scene.num_points)) == ((), 1)


def test_strays_are_left_over(tabletop):
    points, labels, _ = tabletop
    strays = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3)) + [0, 0, 0.9]
    scene = split_scene(np.concatenate([points, strays, [[0, 0, 90.0]]]), "z", EYE)
    assert (scene.object[len(points) :] == LEFT_OVER).all()
    assert len(scene.num_points) == 4
    assert min(overlaps(labels, scene.object[: len(points)])) > 0.85


def test_a_table_is_the_support_though_the_wall_behind_is_larger():
    wall = box([0, 0.7, 0.2], [4, 0.02, 2.2])
    points, labels = seen([table([1.0, 0.9]), wall, *THINGS[1:]], shape=(240, 320))
    scene = split_scene(points, find_up(points, EYE).vector, EYE)
    assert scene.planes[0].normal @ [0, 0, 1] > 0.999
    assert abs(scene.planes[0].offset) < 0.01
    assert len(scene.planes) == 2
    assert ((scene.object == SUPPORT) == (labels <= 1)).mean() > 0.98
    assert len(scene.num_points) == 4
    assert min(overlaps(labels, scene.object, first=2)) > 0.8


def test_a_wall_and_a_floor_that_end_with_the_view_are_no_objects():
    """And no wall behind things alone: these float before it, so up is the camera's."""
    wall, floor = box([0, 0.7, 0.5], [9, 0.02, 9]), box([0, 0, -0.01], [9, 9, 0.02])
    for things, first in (([wall, floor, *THINGS[1:]], 2), ([wall, *THINGS[1:4]], 1)):
        points, labels = seen(things, eye=np.array([0.1, -1.2, 0.6]), shape=(240, 320))
        scene = split_scene(points, AUTO, EYE - [0, 0, 0.3], np.diag([1.0, -1, -1]))
        assert scene.up.vector @ [0, 1, 0] > -0.1 and len(scene.planes) == first
        assert min(overlaps(labels, scene.object, first)) > 0.7


@pytest.mark.parametrize("thing", THINGS[1:4])
def test_one_thing_alone_is_one_object(thing):
    points, _ = seen([thing], shape=(300, 400))
    scene = split_scene(points, "z", EYE)
    assert scene.planes == ()
    assert (scene.object == 0).mean() > 0.98


def test_two_things_far_apart_without_a_table_are_two():
    points, labels = seen([THINGS[1], THINGS[3]])
    scene = split_scene(points, "z", EYE)
    assert sorted(np.bincount(labels)) == sorted(scene.num_points)


def test_a_plane_alone_is_all_support():
    points, _ = seen([THINGS[0]])
    scene = split_scene(points @ TURN.T, "z", TURN @ EYE)
    assert len(scene.planes) == 1
    assert (scene.object == SUPPORT).mean() > 0.98
    assert scene.num_points == ()


def test_a_direction_that_is_none():
    with pytest.raises(InputError, match="has no direction"):
        split_scene(np.ones((5, 3)), np.zeros(3))


def test_a_scanned_tabletop_comes_apart_as_it_is_labelled(real):
    """Without its labels for the table: objects of over 500 points."""
    path = real("kinect/mosd_test24.pcd")
    fields = {}
    points = read_pcd(path, fields=fields)
    finite = np.isfinite(points).all(axis=1)
    labels = fields["label"][finite]
    points = points[finite].astype(float)
    origin = np.zeros(3)
    scene = split_scene(points, find_up(points, origin).vector, origin)
    kinds, counts = np.unique(labels, return_counts=True)
    objects = [kind for kind in kinds[counts > 500] if kind != kinds[counts.argmax()]]
    renamed = np.select(
        [labels == kind for kind in objects], range(1, 1 + len(objects))
    )
    assert len(objects) == 3
    found = np.array(overlaps(renamed, scene.object))
    assert (found > 0.7).mean() >= 0.8
    on_table = labels == kinds[counts.argmax()]
    assert (scene.object[on_table] == SUPPORT).mean() > 0.95
