import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.sequences import (
    CLOUD_STEP,
    flying_pixels,
    make_frame,
    make_sequence,
)
from prism_jax.data.recordings import DEPTH_SCALE, LABELS


@pytest.fixture(scope="module")
def sequence(model, small):
    return make_sequence(model, 3, small, np.random.default_rng(3))


@pytest.fixture(scope="module")
def frame(sequence, small):
    return make_frame(sequence, 1, small, np.random.default_rng(0))


def pixel_points(frame):
    """The world point of every pixel, by the pinhole equations."""
    camera = frame.camera
    rows, columns = np.indices(frame.depth.shape)
    depth = frame.depth * DEPTH_SCALE
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    cx, cy = camera.intrinsics[0, 2], camera.intrinsics[1, 2]
    x, y = (columns - cx) / fx * depth, (rows - cy) / fy * depth
    in_camera = np.stack([x, y, depth], axis=-1)
    return (in_camera - camera.translation) @ camera.rotation


def test_the_partial_is_the_depth_image_of_robot_and_fixtures(frame):
    wanted = np.isin(frame.labels, (LABELS["robot"], LABELS["fixture"]))
    rows = pixel_points(frame)[wanted].astype(np.float32)
    # Row by row, and each point one of those pixels, to half of the stored step.
    position = 0
    for point in frame.partial:
        gap = np.abs(rows[position:] - point).max(axis=1)
        position += int(np.argmax(gap <= CLOUD_STEP / 2 + 1e-6)) + 1
        assert gap.min() <= CLOUD_STEP / 2 + 1e-6
    assert len(frame.partial) > 0.8 * len(rows)


def test_hidden_share_is_that_of_pixels(sequence, frame, small):
    """Against a frame of the same cell without its clutter."""
    bare = dataclasses.replace(sequence.cell, clutter=sequence.cell.clutter.copy())
    bare.clutter.update_faces(np.zeros(len(bare.clutter.faces), bool))
    free = make_frame(
        dataclasses.replace(sequence, cell=bare), 1, small, np.random.default_rng(0)
    )
    seen = [np.count_nonzero(f.labels == LABELS["robot"]) for f in (frame, free)]
    # Fine pixels at the edge of both range limits apart, exact sensors see the same.
    assert frame.joints["hidden_share"] == pytest.approx(
        1 - seen[0] / seen[1], abs=0.01
    )
    assert free.joints["hidden_share"] == 0


def test_flying_pixels_are_those_between_two_surfaces():
    depth = np.full((20, 30), 1.0)
    depth[:, 15:] = 2.0
    depth[4, 15] = 1.4
    depth[9, 14] = 1.7
    depth[12:14, 3:5] = 0.0
    depth[17, 20] = 2.4
    expected = np.zeros(depth.shape, bool)
    for row, column in ((4, 15), (9, 14), (17, 20)):
        expected[row, column] = True
    np.testing.assert_array_equal(flying_pixels(depth), expected)
