"""KITTI's cars, against closed forms, and the real one where it lies."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_jax.data.public.kitti import KITTI
from prism_jax.io import InputError
from prism_jax.io.text import read_text

LENGTH, WIDTH, HEIGHT = 4.0, 1.6, 1.5
PLACE = np.array([12.0, -5.0, -0.9])
UNIT_CORNERS = np.array(
    [(x, y, z) for z in (-1, 1) for x, y in ((-1, 1), (-1, -1), (1, -1), (1, 1))]
)
CORNERS = UNIT_CORNERS * np.array([LENGTH, WIDTH, HEIGHT]) / 2
"""KITTI's order: from above, the rear left, then round by the right; below first."""


def placed(points, yaw):
    return Rotation.from_euler("z", yaw).apply(points) + PLACE


def as_published(points):
    """Box coordinates, length one, the last two axes exchanged."""
    return (points / LENGTH)[:, [0, 2, 1]]


@pytest.fixture
def root(tmp_path, write):
    """Two cars with yaws of 30 and -160 degrees, their corners as points."""
    cars = {"frame_0_car_0": 30.0, "frame_10_car_2": -160.0}
    for name, yaw in cars.items():
        corners = placed(CORNERS, np.radians(yaw))
        write(tmp_path / "bboxes" / f"{name}.txt", corners)
        write(tmp_path / "cars" / f"{name}.pcd", corners[:5])
    entry = {"taxonomy_id": "kitti-car", "taxonomy_name": "Car", "train": []}
    write(tmp_path / "KITTI.json", [entry | {"test": list(cars)}])
    return tmp_path


def test_cars_come_in_their_box_with_the_scanner_and_without_truth(root):
    source = KITTI(root)
    assert (len(source), source.categories) == (2, ("Car",))
    for example, yaw in zip(source, np.radians([30.0, -160.0]), strict=True):
        assert (example.complete, example.category) == (None, "Car")
        expected = as_published(CORNERS[:5])
        np.testing.assert_allclose(example.partial, expected, atol=1e-6)
        scanner = Rotation.from_euler("z", -yaw).apply(-PLACE)[None]
        np.testing.assert_allclose(example.eye, as_published(scanner)[0], atol=1e-5)
    assert source[1].name == "frame_10_car_2"


def test_a_set_that_is_not_whole_is_refused(root):
    with pytest.raises(InputError, match=r"^split: unknown value 'train'; use test"):
        KITTI(root, "train")
    (root / "bboxes" / "frame_10_car_2.txt").unlink()
    with pytest.raises(
        InputError, match=r"1 of the 4 files .*: bboxes/frame_10_car_2.txt;"
    ):
        KITTI(root)


def test_the_real_car_lies_in_its_box_as_the_published_matrices_have_it(
    real, tmp_path, write
):
    for folder, suffix in (("cars", "pcd"), ("bboxes", "txt")):
        path = real(f"kitti/frame_0_car_0.{suffix}")
        write(tmp_path / folder / path.name, path.read_text())
    entry = {"taxonomy_id": "kitti-car", "taxonomy_name": "Car"}
    write(tmp_path / "KITTI.json", [entry | {"test": ["frame_0_car_0"]}])
    example = KITTI(tmp_path)[0]
    assert example.partial.shape == (1524, 3)

    corners = read_text(real("kitti/frame_0_car_0.txt"))
    heading = corners[3] - corners[0]
    yaw = np.arctan2(heading[1], heading[0])
    turn = Rotation.from_euler("z", -yaw)
    scan = np.loadtxt(real("kitti/frame_0_car_0.pcd"), skiprows=10)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    expected = turn.apply(scan - middle) / np.hypot(heading[0], heading[1])
    np.testing.assert_allclose(example.partial, expected[:, [0, 2, 1]], atol=1e-6)
    box = turn.apply(corners - middle) / np.hypot(heading[0], heading[1])
    inside = np.abs(example.partial) <= np.abs(box).max(axis=0)[[0, 2, 1]] + 0.02
    assert inside.all(axis=1).mean() > 0.95
