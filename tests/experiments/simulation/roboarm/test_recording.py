"""Recordings of a simulated cell."""

import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm import recording
from experiments.simulation.roboarm.sequences import make_frame, make_sequence
from prism_jax.data.recordings import DEPTH_SCALE, RecordedCells
from prism_jax.io.streams import open_stream

highlevel = pytest.importorskip("rosbags.highlevel")


def made(model, small):
    rng = np.random.default_rng(0)
    small = dataclasses.replace(small, width=160, height=120)
    sequence = make_sequence(model, 3, small, rng)
    return [make_frame(sequence, number, small, rng) for number in range(3)]


def test_a_recording_has_what_sensors_measure_and_the_truth_beside(
    model, small, tmp_path
):
    frames = made(model, small)
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
        # Nobody tells where the camera is; with its pose points are in the cell.
        np.testing.assert_array_equal(read.camera.rotation, np.eye(3))
    placed = next(iter(open_stream(path, camera=frames[0].camera)))
    assert abs(placed.points[:, 2].min()) < 0.01  # the floor's height
    with highlevel.AnyReader([path]) as bag:
        found = [c for c in bag.connections if c.topic == recording.JOINTS_TOPIC]
        for frame, (connection, _, data) in zip(
            frames, bag.messages(found), strict=True
        ):
            message = bag.deserialize(data, connection.msgtype)
            assert (
                dict(zip(message.name, message.position, strict=True))
                == frame.joints["positions"]
            )
    cells = RecordedCells(beside)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(cells.read(number).complete, frame.complete)
