"""KITTI's cars: real scans with a labelled box, and no ground truth.

Cut by Yuan et al. (PCN, 3DV 2018) from a raw drive of KITTI (Geiger et al., IJRR 2013),
in the layout of GRNet's and PoinTr's release: `root` holds KITTI.json, a list of cars,
cars/<name>.pcd and bboxes/<name>.txt, eight lines with the corners of the car's box, in
the scanner's frame and in metres: x forward, y left, z up.
"""

import pathlib

import numpy as np
from jaxtyping import Float, Float64

from prism_jax.data.public.layout import (
    ListedSource,
    read_cloud,
    read_json_list,
    require_files,
    sound_cloud,
)
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError, StrPath, choose
from prism_jax.io.text import read_text


class KITTI(ListedSource):
    """Cars in the frame of their box, as `to_box_frame` has it; `complete` is None.
    `eye` is the scanner's position in that frame. The list is `root`/`list_file`."""

    def __init__(
        self, root: StrPath, split: str = "test", list_file: str = "KITTI.json"
    ):
        root = pathlib.Path(root)
        choose("split", split, ["test"])
        cars = read_json_list(root / list_file, split)
        super().__init__(root, cars, views=1)
        wanted = {
            "cars": [f"{car.id}.pcd" for car in cars],
            "bboxes": [f"{car.id}.txt" for car in cars],
        }
        require_files(root, wanted, list_file, "cars/<name>.pcd and bboxes/<name>.txt")

    def __getitem__(self, index: int) -> Example:
        car, _ = self.locate(index)
        path = self.root / "cars" / f"{car.id}.pcd"
        corners = read_corners(self.root / "bboxes" / f"{car.id}.txt")
        scan = to_box_frame(read_cloud(path).astype(np.float64), corners)
        eye = to_box_frame(np.zeros((1, 3)), corners)[0]
        partial = sound_cloud(scan, path)
        return Example(None, partial, eye.astype(np.float32), car.category, car.id)


def to_box_frame(
    points: Float64[np.ndarray, "N 3"], corners: Float[np.ndarray, "8 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Points of the scanner's frame in the frame that the completion literature uses.

    The origin is the middle of the corners' axis-aligned box, the heading from corner 0
    to corner 3 becomes +x, up +y, and the box's length one; left and right are
    exchanged, as published (PCN's test_kitti.py; GRNet's and PoinTr's loaders). Corners
    0 and 3 at one place raise ValueError.
    """
    center = (corners.min(axis=0) + corners.max(axis=0)) / 2
    along_x, along_y = corners[3, :2].astype(np.float64) - corners[0, :2]
    length = np.hypot(along_x, along_y)
    if not length > 0:
        raise ValueError("corners 0 and 3 coincide, so the box has no heading")
    cosine, sine = along_x / length, along_y / length
    x, y, z = (points - center).T
    forward, left = cosine * x + sine * y, cosine * y - sine * x
    return np.stack([forward, z, left], axis=1) / length


def read_corners(path: StrPath) -> Float64[np.ndarray, "8 3"]:
    """The corners of a car's box, in the scanner's frame; InputError of anything else.
    From corner 0 edges lead to 1, 3 and 4, and that to 3 is the heading."""
    corners = read_text(path)
    is_box = corners.shape == (8, 3) and bool(np.isfinite(corners).all())
    if not is_box or np.array_equal(corners[0, :2], corners[3, :2]):
        fault = "not the eight corners of a box"
        raise InputError(path, fault, "copy this file again from the data set")
    return corners
