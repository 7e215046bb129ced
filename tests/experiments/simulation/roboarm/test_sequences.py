"""Frames of a robot in its cell: what the camera saw, and the ground truth."""

import numpy as np
import pytest

from experiments.simulation.roboarm import recording
from experiments.simulation.roboarm.sequences import (
    CLOUD_STEP,
    make_frame,
    make_sequence,
)
from prism_jax.data.recordings import DEPTH_SCALE, LABELS, RecordedCells
from prism_jax.envelope.robot import joints_from_dict, of_robot, robot_surface
from prism_jax.io.depth import points_from_depth
from prism_jax.io.streams import open_stream
from prism_jax.robots.urdf import Linkage


@pytest.fixture(scope="module")
def sequence(model, small):
    return make_sequence(model, 3, small, np.random.default_rng(3))


@pytest.fixture(scope="module")
def frame(sequence, small):
    return make_frame(sequence, 1, small, np.random.default_rng(0))


def test_the_partial_is_the_depth_image_of_robot_and_fixtures(frame):
    """Row by row, to half of the stored step; pixels by the pinhole equations."""
    camera = frame.camera
    rows, columns = np.indices(frame.depth.shape)
    depth = frame.depth * DEPTH_SCALE
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    cx, cy = camera.intrinsics[0, 2], camera.intrinsics[1, 2]
    x, y = (columns - cx) / fx * depth, (rows - cy) / fy * depth
    points = np.stack([x, y, depth], axis=-1) - camera.translation
    wanted = np.isin(frame.labels, (LABELS["robot"], LABELS["fixture"]))
    rows = (points @ camera.rotation)[wanted].astype(np.float32)
    position = 0
    for point in frame.partial:
        gap = np.abs(rows[position:] - point).max(axis=1)
        position += int(np.argmax(gap <= CLOUD_STEP / 2 + 1e-6)) + 1
        assert gap.min() <= CLOUD_STEP / 2 + 1e-6
    assert len(frame.partial) > 0.8 * len(rows)


def test_the_robot_is_where_its_base_and_joints_say(frame, urdf):
    """Its pixels lie on its model, and none does where the base is left out."""
    joints, base = joints_from_dict(frame.joints, based=True)
    depth = np.where(frame.labels == LABELS["robot"], frame.depth * DEPTH_SCALE, 0)
    pixels = points_from_depth(depth, depth > 0, frame.camera)
    assert len(pixels) > 50
    for place, expected in ((base, 1.0), (np.eye(4), 0.0)):
        surface = robot_surface(Linkage(urdf), joints, place)
        assert of_robot(pixels, surface).mean() == pytest.approx(expected, abs=0.02)


def test_a_recording_has_what_sensors_measure_and_the_truth_beside(
    sequence, small, tmp_path
):
    highlevel = pytest.importorskip("rosbags.highlevel")
    rng = np.random.default_rng(0)
    frames = [make_frame(sequence, number, small, rng) for number in range(3)]
    path = tmp_path / "cell.mcap"
    beside = recording.record(path, frames, rate=5.0)
    assert beside == tmp_path / "cell"
    stream = open_stream(path)
    assert stream.topic == recording.DEPTH_TOPIC and len(stream) == 3
    for number, (read, frame) in enumerate(zip(stream, frames, strict=True)):
        metres = frame.depth * DEPTH_SCALE
        np.testing.assert_allclose(read.depth, metres, atol=0.00051)
        assert read.timestamp - recording.START == number * 200_000_000
        np.testing.assert_allclose(read.camera.intrinsics, frame.camera.intrinsics)
        # The stream does not say where the camera is.
        np.testing.assert_array_equal(read.camera.rotation, np.eye(3))
    placed = next(iter(open_stream(path, camera=frames[0].camera)))
    assert abs(placed.points[:, 2].min()) < 0.01  # the floor's height
    with highlevel.AnyReader([path]) as bag:
        found = [c for c in bag.connections if c.topic == recording.JOINTS_TOPIC]
        messages = bag.messages(found)
        for frame, (connection, _, data) in zip(frames, messages, strict=True):
            message = bag.deserialize(data, connection.msgtype)
            positions = dict(zip(message.name, message.position, strict=True))
            assert positions == frame.joints["positions"]
    cells = RecordedCells(beside)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(cells.read(number).complete, frame.complete)
