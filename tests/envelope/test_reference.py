"""Surfaces whose place is known, and views that contradict it."""

import numpy as np
import pytest

from prism_jax.envelope.carving import (
    Carving,
    CloudView,
    DepthView,
    check_robot,
    compare,
)
from prism_jax.envelope.reference import check_reference, reference_of
from prism_jax.io.errors import InputError
from tests.envelope.test_carving import FAR, camera_at

RNG = np.random.default_rng(0)
WALL = np.column_stack([RNG.uniform(-1, 1, (4000, 2)), np.full(4000, 2.0)])


def views(distance=2.0, box=None, origin=np.zeros(3)):
    """A wall at a distance, and a box of a metre before it, in an image and a cloud."""
    camera = camera_at(origin, 160, 120, 80.0)
    depth = np.full((120, 160), float(distance))
    if box is not None:
        depth[40:80, 60:100] = box
    rows, columns = np.indices(depth.shape)
    rays = [(columns - 79.5) / 80, (rows - 59.5) / 80, np.ones(depth.shape)]
    points = (depth[..., None] * np.stack(rays, axis=-1)).reshape(-1, 3)
    image = DepthView(depth, camera)
    return {"image": image, "cloud": CloudView(points + origin, origin)}


@pytest.mark.parametrize("kind", ["image", "cloud"])
@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
def test_points_are_on_before_or_behind_what_was_measured(kind, origin):
    view = views(origin=origin)[kind]
    for depth, expected in ((2.0, (1, 0)), (1.5, (0, 1)), (2.5, (0, 0))):
        points = WALL[:500] * [0.5, 0.5, depth / 2] + origin
        told = [some.mean() for some in compare(view, points, 0.03)]
        assert told == list(expected)
    beside = np.array([[9.0, 0, 2], [0, 0, -2.0]]) + origin
    assert not np.any(compare(view, beside, 0.03))


@pytest.mark.parametrize("kind", ["image", "cloud"])
def test_a_reference_holds_what_stands_still_and_refuses_what_moved(kind):
    with_box, points = views(box=1.5), WALL.copy()
    points[np.abs(WALL[:, :2]).max(1) < 0.3] *= 0.75
    empty = views()[kind]
    kept = reference_of([(with_box[kind], points)])
    assert {1.5, 2.0} == set(kept[:, 2].round(6))
    assert set(reference_of([(with_box[kind], points), (empty, WALL)])[:, 2]) == {2.0}
    check_reference(with_box[kind], kept)
    # A person before the wall hides it, and moves nothing.
    check_reference(views(box=0.8)[kind], kept[kept[:, 2] == 2.0])
    # The box is gone; the camera stands 10 cm farther away; it sees something else.
    for wrong, told in (
        (empty, "has moved or is gone"),
        (views(2.1, 1.6)[kind], r"100\.0% of what is seen of it has moved"),
        (views(0.5)[kind], "only 0% of it is seen"),
    ):
        with pytest.raises(InputError, match=told):
            check_reference(wrong, kept)
    with pytest.raises(InputError, match="nothing stands still"):
        reference_of([])


@pytest.mark.parametrize("kind", ["image", "cloud"])
def test_a_robot_is_where_the_scan_shows_it(kind):
    view = views(box=1.5)[kind]
    front = np.column_stack([RNG.uniform(-0.3, 0.3, (900, 2)), np.full(900, 1.5)])
    robot = np.concatenate([front, front + [0, 0, 0.3]])
    check_robot(view, robot, Carving())
    for wrong in ([0, 0, 0.8], [0.9, 0, 0], [0, 0, -0.1]):
        with pytest.raises(InputError, match="check --base, --joints"):
            check_robot(view, robot + wrong, Carving())
