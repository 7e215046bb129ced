"""What is written is what others read."""

import numpy as np
import pytest

from experiments.simulation.roboarm.recording import (
    camera_message,
    depth_message,
    joints_message,
)
from prism_jax.geometry.camera import Camera
from prism_jax.io.clouds import read_points
from prism_jax.io.errors import InputError
from prism_jax.io.streams import open_stream
from prism_jax.io.streams.mcap import McapFile
from prism_jax.io.streams.sinks import TOPIC, Labelled, McapOutput, open_sink

highlevel = pytest.importorskip("rosbags.highlevel")
reader = pytest.importorskip("mcap.reader")

POINTS = np.random.default_rng(0).normal(size=(50, 3))
LABEL = np.repeat(np.arange(3, dtype=np.uint8), [20, 20, 10])


@pytest.mark.parametrize("scalar", [np.float32, np.float64])
def test_clouds_with_labels(scalar, tmp_path):
    path = tmp_path / "new" / "out.mcap"
    sink = open_sink(path)
    (left,) = path.parent.glob(".out.*.part.mcap")
    assert not McapFile(left).counts()
    points = POINTS.astype(scalar)
    fields = {"ring": np.arange(1, 21, dtype=np.uint16), "label": np.arange(20.0)}
    for number in range(3):
        time, kept = 7_000_000_000 + number, fields if number else None
        sink.write(Labelled(number, time, points + number, LABEL, "cam", kept))
    assert not path.exists()
    # What a killed program leaves is read up to the last frame.
    assert len(list(open_stream(left, tell=lambda _: None))) == 3
    sink.close()
    sink.close()
    assert not left.exists()
    stream = open_stream(path)
    assert stream.topic == TOPIC and len(stream) == 3
    for number, frame in enumerate(stream):
        np.testing.assert_array_equal(frame.points, points + number)
        assert frame.frame_id == "cam"
        assert frame.points.dtype == scalar
        assert frame.timestamp == 7_000_000_000 + number
        np.testing.assert_array_equal(frame.fields.pop("label"), LABEL)
        assert [*frame.fields] == ["ring", "input_label"][: 2 * number]
        for column, given in zip(frame.fields.values(), fields.values(), strict=False):
            np.testing.assert_array_equal(column[:20], given)
            rest = np.zeros(30) if given.dtype == np.uint16 else np.full(30, np.nan)
            np.testing.assert_array_equal(column[20:], rest)
            assert column.dtype == given.dtype
    with highlevel.AnyReader([path]) as bag:
        (connection,) = bag.connections
        for _, time, data in bag.messages():
            message = bag.deserialize(data, connection.msgtype)
            rows = message.data.reshape(50, message.point_step)
            (label,) = [f for f in message.fields if f.name == "label"]
            np.testing.assert_array_equal(rows[:, label.offset], LABEL)
            assert time == 7_000_000_000 + message.header.stamp.nanosec
    with open(path, "rb") as file:
        summary = reader.make_reader(file, validate_crcs=True).get_summary()
    assert summary.statistics.message_count == 3
    # Of nothing no file is left, and an older one stays.
    open_sink(path).close()
    assert not left.exists() and len(open_stream(path)) == 3
    sink = open_sink(path)
    late = 2**31 * 10**9 + 7  # later than a header can say
    sink.write(Labelled(0, late, points, LABEL))
    sink.close()
    ((frame_id, time),) = [(f.frame_id, f.timestamp) for f in open_stream(path)]
    assert (frame_id, time) == ("sensor", late)


def test_a_file_a_frame_and_a_place_that_cannot_be_written(tmp_path):
    sink = open_sink(tmp_path / "out")
    sink.write(Labelled(12, 0, POINTS, LABEL))
    sink.close()
    (path,) = (tmp_path / "out").iterdir()
    assert path.name == "000012.ply"
    np.testing.assert_array_equal(read_points(path), POINTS)
    (tmp_path / "out.mcap").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        McapOutput(tmp_path / "out.mcap")


def test_depth_camera_and_joints(tmp_path):
    intrinsics = np.array([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]])
    camera = Camera(np.eye(3), np.zeros(3), intrinsics, 4, 6)
    counts = np.arange(24, dtype=np.uint16).reshape(4, 6)
    output = McapOutput(tmp_path / "out.mcap")
    output.add("/d/image", 5, depth_message(output.types, counts, 5))
    output.add("/d/camera_info", 5, camera_message(output.types, camera, 5))
    joints = joints_message(output.types, {"elbow": 0.5, "wrist": -1.0}, 5)
    output.add("/joint_states", 5, joints)
    output.close()
    (frame,) = open_stream(tmp_path / "out.mcap")
    np.testing.assert_allclose(frame.depth, 0.001 * counts)
    np.testing.assert_allclose(frame.camera.intrinsics, camera.intrinsics)
    with highlevel.AnyReader([tmp_path / "out.mcap"]) as bag:
        found = [c for c in bag.connections if c.topic == "/joint_states"]
        ((connection, _, data),) = bag.messages(found)
        message = bag.deserialize(data, connection.msgtype)
    assert message.name == ["elbow", "wrist"]
    assert message.position.tolist() == [0.5, -1.0]
