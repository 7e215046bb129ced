"""Bags, .db3 and MCAP files that other packages wrote."""

import contextlib
import os
import re
import sqlite3
import sys

import numpy as np
import pytest

from prism_jax.geometry.camera import Camera
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError
from prism_jax.io.streams import Joints, messages, open_stream
from tests.io.streams.recorded import (
    CLOUD,
    IMAGE,
    INFO,
    JOINTS,
    ROS2,
    SECOND,
    TEXT,
    WRITERS,
    cloud,
    image,
    info,
    joints,
    store_of,
    write_mcap,
)

RNG = np.random.default_rng(0)
CLOUDS = [RNG.normal(size=(n, 3)).astype(np.float32) for n in (200, 150, 300, 180)]
START = 1_700_000_000 * SECOND


def clouds(store, topic="/points"):
    """Four clouds a tenth of a second apart, and some words between them."""
    found = []
    for number, points in enumerate(CLOUDS):
        time = START + number * SECOND // 10
        found.append((topic, CLOUD, time + 5, cloud(points, time, store)))
        words = store.types[TEXT](data="is not a cloud")
        found.append(("/chatter", TEXT, time + 6, words))
    return found


def lines_of(stream):
    """The frames, and what was told."""
    lines = []
    stream._tell = lines.append
    return list(stream), lines


@pytest.mark.parametrize("writer", WRITERS)
def test_clouds_are_read_as_they_were_written(writer, tmp_path):
    path = WRITERS[writer](tmp_path, clouds(store_of(writer)))
    stream = open_stream(path)
    assert len(stream) == 4 and stream.topic == "/points"
    for _ in range(2):
        frames, lines = lines_of(stream)
        assert not lines
        for number, (frame, points) in enumerate(zip(frames, CLOUDS, strict=True)):
            np.testing.assert_array_equal(frame.points, points)
            assert frame.points.dtype == np.float32
            assert frame.timestamp == START + number * SECOND // 10
            assert frame.camera is None and frame.depth is None
            assert frame.frame_id == stream.frame_id == "lidar"


@pytest.mark.parametrize("writer", ["bag", "bag-lz4", "db3", "mcap-zstd", "mcap-plain"])
def test_a_cut_file_gives_every_whole_message_and_one_line(writer, tmp_path):
    many = [m for _ in range(10) for m in clouds(store_of(writer))]
    path = WRITERS[writer](tmp_path, many)
    data = path.read_bytes()
    for share in (0.6, 0.95):
        path.write_bytes(data[: int(share * len(data))])
        stream = open_stream(path)
        frames, lines = lines_of(stream)
        assert len(frames) == len(stream)
        least = 0 if writer.startswith(("bag", "db3")) else int(40 * share) - 4
        assert least <= len(frames) <= 40
        for number, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.points, CLOUDS[number % 4])
        assert sum("is truncated or damaged" in line for line in lines) == 1
        assert stream.remarks["cut"] == 1


def test_a_cut_plain_chunk_gives_its_whole_messages(tmp_path):
    """All 40 are in one chunk, of which a half is there."""
    many = [m for _ in range(10) for m in clouds(ROS2)]
    path = write_mcap(tmp_path / "r.mcap", many, "NONE", 10**9)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    frames, _ = lines_of(open_stream(path))
    assert 18 <= len(frames) <= 21


def test_what_is_no_recording_is_one_line(tmp_path):
    for suffix in (".bag", ".db3", ".mcap"):
        path = tmp_path / f"r{suffix}"
        for content in (b"", b"not a recording at all" * 9):
            path.write_bytes(content)
            with pytest.raises(InputError, match=": not a"):
                open_stream(path)
        path.unlink()
        os.mkfifo(path)
        with pytest.raises(InputError, match=": not a file"):
            open_stream(path)
        path.unlink()
    path = WRITERS["db3"](tmp_path, clouds(ROS2))
    (tmp_path / "cut.db3").write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="ends within its first page"):
        open_stream(tmp_path / "cut.db3")
    path = WRITERS["bag"](tmp_path, clouds(store_of("bag")))
    path.write_bytes(path.read_bytes().replace(b"op=", b"po=", 1))
    with pytest.raises(InputError, match="found nothing"):
        open_stream(path)


@pytest.mark.parametrize(
    ("writer", "bytes_of", "instead", "told"),
    [
        ("bag", rb"op=\x02", b"op=x", "messages are missing: 1"),
        ("bag", rb"(?s)index_pos=.{8}", b"index_pos=" + bytes(8), "was never closed"),
        ("mcap-plain", b"lidar", b"radar", "damaged chunk (a checksum is wrong)"),
        ("mcap-unchunked", rb"(?s)\x05(?=.{8}\x01\0)", b"x", "messages are missing: 1"),
    ],
)
def test_what_is_missing_is_told(writer, bytes_of, instead, told, tmp_path):
    path = WRITERS[writer](tmp_path, clouds(store_of(writer)))
    path.write_bytes(re.sub(bytes_of, instead, path.read_bytes(), count=1))
    frames, (line,) = lines_of(open_stream(path))
    assert f"{told}; the {len(frames)} complete messages are used" in line


ENDLESS = (
    "WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) SELECT id, "
)


@pytest.mark.parametrize(
    ("table", "columns"),
    [
        ("topics", "'/p' AS name, 't' AS type, 'cdr' AS serialization_format"),
        ("messages", "1 AS topic_id, 1 AS timestamp, x'' AS data"),
    ],
)
def test_of_a_database_only_tables_are_read_and_gaps_told(table, columns, tmp_path):
    path = WRITERS["db3"](tmp_path, clouds(ROS2))
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("DELETE FROM messages WHERE id = 3")
        database.commit()
        _, (line,) = lines_of(open_stream(path))
        assert "messages are missing: 1; the 3 complete" in line
        view = f"CREATE VIEW {table} AS {ENDLESS} {columns} FROM c"
        database.executescript(f"DROP TABLE {table}; {view}")
    with pytest.raises(InputError, match=r"not a ROS 2 bag|found nothing"):
        open_stream(path)


def test_a_small_file_does_not_unpack_to_a_large_one(tmp_path, monkeypatch):
    path = WRITERS["mcap-zstd"](tmp_path, clouds(ROS2))
    monkeypatch.setattr(messages, "_TIMES", 0)
    monkeypatch.setattr(messages, "_LARGEST", 8000)
    stream = open_stream(path, tell=lambda _: None)
    assert 0 < len(list(stream)) < 4 and stream.remarks == {"cut": 1}
    unpacker = messages.Unpacker(path)
    with pytest.raises(ValueError, match="too many records"):
        while True:
            unpacker.count_record()


@pytest.mark.parametrize("writer", ["bag", "db3", "mcap-zstd", "mcap-plain"])
def test_any_bytes_may_be_wrong(writer, tmp_path, monkeypatch):
    """Whatever is damaged, there is no other error, and no more frames. The clouds are
    small, so that it often is a record's head."""
    monkeypatch.setattr(sys.modules[__name__], "CLOUDS", [c[:3] for c in CLOUDS])
    place = WRITERS[writer](tmp_path, clouds(store_of(writer)))
    place = next(place.glob("*.db3")) if place.is_dir() else place
    data, rng = bytearray(place.read_bytes()), np.random.default_rng(1)
    for _ in range(60):
        spoilt = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            spoilt[rng.integers(len(data))] = rng.integers(256)
        place.write_bytes(spoilt)
        try:
            frames, _ = lines_of(open_stream(place))
        except InputError:
            continue
        assert len(frames) <= 8


@pytest.mark.parametrize("big", [False, True])
def test_layouts_of_clouds(big, tmp_path):
    for scalar in (np.float32, np.float64):
        points = RNG.normal(size=(12, 3)).astype(scalar)
        message = cloud(points, START, height=3, big=big, gap=8, tail=5)
        message.row_step *= not big  # 0 where nobody filled it in
        path = write_mcap(tmp_path / "r.mcap", [("/p", CLOUD, 1, message)])
        (frame,) = open_stream(path)
        np.testing.assert_array_equal(frame.points, points)
        assert frame.points.dtype == scalar
        assert [*frame.fields] == ["intensity"]
        np.testing.assert_array_equal(frame.fields["intensity"], np.arange(12))


def test_odd_frames_are_told_and_counted(tmp_path):
    points = CLOUDS[0]
    some, none = points.copy(), np.full_like(points, np.nan)
    some[:7] = np.nan
    some[7:10] = 0.0
    wide, tall = cloud(points, START, height=2), cloud(points, START, height=4)
    short, nameless = cloud(points, START), cloud(points, START)
    short.data = short.data[:-9]
    nameless.fields = nameless.fields[:2]
    later = (some, none, points[:0])
    given = [cloud(rows, START + n * SECOND) for n, rows in enumerate(later, 1)]
    given += [short, nameless, wide, cloud(points, START, frame_id="radar"), tall]
    messages = [("/p", CLOUD, n, message) for n, message in enumerate(given)]
    stream = open_stream(write_mcap(tmp_path / "r.mcap", messages))
    frames, lines = lines_of(stream)
    assert [len(frame.points) for frame in frames] == [190, 0, 0, 200, 200]
    np.testing.assert_array_equal(frames[0].fields["intensity"], np.arange(10, 200))
    assert [frame.num_not_finite for frame in frames] == [10, 200, 0, 0, 0]
    kinds = {"not_finite": 1, "empty": 1, "damaged": 2, "backward": 1}
    assert stream.remarks == kinds | {"sensor": 1, "duplicate": 1, "no_return": 1}
    for line, words in zip(
        lines,
        (
            "frame 0: 3 of 200 points are at 0,0,0 and count as no return",
            "frame 1: no return in 200 points",
            "frame 2 is empty",
            "skipped a message on /p: ",
            "frame 3 is 3.000 s older than the one before",
            "frame 4 is of 'radar', the first of 'lidar'; only those are used",
            "frame 4 has the time of the one before",
        ),
        strict=True,
    ):
        assert words in line


@pytest.mark.parametrize(
    ("writer", "encoding"), [("bag", "16UC1"), ("db3", "32FC1"), ("mcap-zstd", "16UC1")]
)
def test_depth_images_with_their_camera(writer, encoding, tmp_path):
    store = store_of(writer)
    metres = np.round(RNG.uniform(0.5, 2.0, (6, 8)), 3)
    metres[0, :3] = 0.0
    pixels = np.rint(1000 * metres).astype(np.uint16)
    pixels[0, 0] = 65535
    if encoding == "32FC1":
        pixels = metres.astype(np.float32)
        pixels[0, 0] = np.inf
    messages = [
        ("/cam/depth", IMAGE, 1, image(pixels, START, store, encoding, padding=4)),
        ("/cam/camera_info", INFO, 2, info(8, 6, 10.0, store=store)),
        ("/cam/rgb", IMAGE, 3, image(np.zeros((6, 24), np.uint8), 0, store, "rgb8")),
    ]
    about = {"store": store, "distortion": 0.1, "rectified": 500.0}
    messages.append(("/rgb/camera_info", INFO, 4, info(8, 6, 615.0, **about)))
    for name in ("raw", "rect_raw"):
        given = image(pixels, START, store, encoding)
        messages.append((f"/d/image_{name}", IMAGE, 5, given))
    path = WRITERS[writer](tmp_path, messages)
    stream = open_stream(path, "/cam/depth")
    assert stream.topic == "/cam/depth" and len(stream) == 1
    (frame,), lines = lines_of(stream)
    (line,) = lines
    assert "frame 0: 1 pixels of" in line and stream.remarks == {"no_return": 1}
    assert frame.timestamp == START and frame.depth.shape == (6, 8)
    np.testing.assert_allclose(frame.depth, metres, atol=1e-6)
    mask = metres > 0
    wanted = points_from_depth(frame.depth, mask, frame.camera)
    np.testing.assert_array_equal(frame.points, wanted)
    assert frame.camera.intrinsics[0, 0] == 10.0 and frame.camera.width == 8
    # Another topic's are nobody's unless it is named, and rectified images' its P.
    infos = "set --camera to one of /cam/camera_info, /rgb/camera_info"
    with pytest.raises(InputError, match=f"on /c.json; {infos}"):
        open_stream(path, "/d/image_raw", "/c.json")
    for name, *wanted in (("raw", 615, 3.5), ("rect_raw", 500, 1)):
        stream = open_stream(path, f"/d/image_{name}", "/rgb/camera_info")
        (frame,), lines = lines_of(stream)
        assert frame.camera.intrinsics[0, [0, 2]].tolist() == wanted
        assert sum("lens" in line for line in lines) == (name == "raw")
        assert frame.frame_id == "lidar"


def test_bags_of_a_realsense(tmp_path):
    """Its CameraInfo lies elsewhere, and counts are of its own unit."""
    sensor, store = "/device_0/sensor_0", store_of("bag")
    pixels = np.full((4, 4), 4000, np.uint16)
    units = store.types["std_msgs/msg/Float32"](data=0.00025)
    color, depth = (info(4, 4, focal, store=store) for focal in (9.0, 5.0))
    counts = image(pixels, START, store, "mono16")
    messages = [
        (f"{sensor}/option/Depth_Units/value", "std_msgs/msg/Float32", 0, units),
        ("/device_0/sensor_1/Color_0/info/camera_info", INFO, 0, color),
        (f"{sensor}/Depth_0/info/camera_info", INFO, 0, depth),
        (f"{sensor}/Depth_0/image/data", IMAGE, 1, counts),
    ]
    (frame,) = open_stream(WRITERS["bag"](tmp_path, messages))
    np.testing.assert_allclose(frame.depth, 1.0)
    assert frame.camera.intrinsics[0, 0] == 5.0
    units.data = np.inf
    (tmp_path / "r.bag").unlink()
    frames, (line,) = lines_of(open_stream(WRITERS["bag"](tmp_path, messages)))
    assert not frames and "its points are not finite" in line


def test_a_missing_camera_info_is_one_line_and_a_camera_helps(tmp_path):
    message = image(np.full((4, 4), 1000, np.uint16), START)
    path = write_mcap(tmp_path / "r.mcap", [("/cam/depth", IMAGE, 1, message)])
    told = "no CameraInfo on /cam/camera_info; record /c"
    with pytest.raises(InputError, match=told):
        open_stream(path)
    both = [("/cam/depth", IMAGE, 1, message), ("/rgb", INFO, 1, info(4, 4, 615.0))]
    with pytest.raises(InputError, match="set --camera to one of /rgb, or to a JSON"):
        open_stream(write_mcap(tmp_path / "both.mcap", both))
    intrinsics = np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    down = np.diag([1.0, -1, -1])
    given = Camera(down, np.array([0, 0, 3.0]), intrinsics, 4, 4)
    (frame,) = open_stream(path, camera=given)
    assert frame.frame_id == ""
    # One metre in front of a camera that looks down from three.
    np.testing.assert_allclose(frame.points[:, 2], 2.0, atol=1e-6)


def test_an_image_of_another_size_and_a_distortion_are_told(tmp_path):
    one, other = (np.full((4, width), 900, np.uint16) for width in (4, 6))
    messages = [
        ("/camera_info", INFO, 0, info(4, 4, 5.0, distortion=0.1)),
        ("/depth", IMAGE, 1, image(one, START)),
        ("/depth", IMAGE, 2, image(other, START)),
        ("/camera_info", INFO, 3, info(6, 4, 5.0, distortion=0.1)),
        ("/depth", IMAGE, 4, image(other, START)),
    ]
    stream = open_stream(write_mcap(tmp_path / "r.mcap", messages))
    frames, lines = lines_of(stream)
    assert [f.depth.shape for f in frames] == [(4, 4), (4, 6)]
    told = " | ".join(lines)
    assert "image is 6x4, camera is 4x4" in told
    assert "/camera_info has lens distortion, which is ignored" in told
    assert "/camera_info has another size or other intrinsics than before" in told
    assert stream.remarks["camera"] == 1


def test_several_topics_are_listed_and_a_file_without_says_what_it_holds(tmp_path):
    both = clouds(ROS2, "/front") + clouds(ROS2, "/rear")[:2]
    path = write_mcap(tmp_path / "r.mcap", both)
    with pytest.raises(InputError) as error:
        open_stream(path)
    assert str(error.value).endswith("set --topic to one of /front, /rear")
    assert len(open_stream(path, "/front")) == 4
    assert len(open_stream(path, "/rear")) == 1
    with pytest.raises(InputError, match="no clouds or depth images on /side"):
        open_stream(path, "/side")
    with pytest.raises(InputError, match="does not say where clouds are"):
        open_stream(path, "/rear", "/camera_info")
    messages = [m for m in both if m[0] == "/chatter"]
    # Infrared, unless somebody says that it is depth.
    grey = image(np.ones((4, 4), np.uint16), 0, encoding="mono16")
    messages += [("/ir", IMAGE, 1, grey), ("/camera_info", INFO, 0, info(4, 4, 5.0))]
    depth = tmp_path / "depth.mcap"
    write_mcap(depth, [*messages, ("/Depth", IMAGE, 1, grey)])
    assert open_stream(depth).topic == "/Depth"
    path = write_mcap(tmp_path / "r.mcap", messages)
    with pytest.raises(InputError, match=r"found /chatter \(std_msgs/msg/String\)"):
        open_stream(path)
    assert len(list(open_stream(path, "/ir"))) == 1


def test_a_split_recording_is_one_and_without_a_stamp_the_log_tells_the_time(tmp_path):
    for number in (10, 9):
        message = ("/p", CLOUD, number, cloud(CLOUDS[number % 4], 0))
        write_mcap(tmp_path / f"r_{number}.mcap", [message])
    frames, lines = lines_of(open_stream(tmp_path))
    assert [len(f.points) for f in frames] == [len(CLOUDS[1]), len(CLOUDS[2])]
    assert [f.timestamp for f in frames] == [9, 10] and not lines


@pytest.mark.parametrize(
    ("names", "listed"),
    [
        ("a_0 b_0", None),
        ("a a_1", ""),
        ("a b", ["a.mcap", "'run/b.mcap'"]),
        ("a b", ["a.mcap"]),
        ("2024-01-02-03-04-05_0 2024-01-02-03-05-05_1", ""),  # as ROS 1 splits bags
        ("2024-01-02-03-04-05 2024-01-02-03-05-05", None),
        ("2024-01-02-03-04-05_0 2024-01-02-03-05-05_0", None),
    ],
)
def test_a_folder_is_one_recording_or_refused(names, listed, tmp_path):
    for name in names.split():
        write_mcap(tmp_path / f"{name}.mcap", clouds(ROS2)[:1])
    if listed:
        lines = "".join(f"    - {name}\n" for name in listed)
        (tmp_path / "metadata.yaml").write_text(f"  relative_file_paths:\n{lines}")
    if listed is None or len(listed) == 1:
        with pytest.raises(InputError, match=r"\.mcap, .*mcap; give one of them"):
            open_stream(tmp_path)
    else:
        assert len(open_stream(tmp_path)) == 2


def told_joints(found):
    return [frame.joints and frame.joints["positions"] for frame in found]


def states(store, *told):
    """Joint states of positions, so many seconds after the start."""
    timed = [(positions, START + round(after * SECOND)) for positions, after in told]
    return [("/joint_states", JOINTS, t, joints(p, t, store)) for p, t in timed]


@pytest.mark.parametrize("writer", ["bag", "db3", "mcap-zstd"])
def test_joints_are_interpolated_at_each_frames_time(writer, tmp_path):
    """Of each joint by itself, by stamps; samples may come after later frames."""
    store = store_of(writer)
    told = [
        ({"a": 1.0, "b": 2.0}, 0.0),
        ({"a": 2.0}, 0.04),
        ({"b": 3.0}, 0.1),
        ({"a": 4.0}, 0.12),
        ({"a": 4.0}, 0.22),
        ({"b": 6.0}, 0.3),  # 0.2 s after the one before
        ({"a": 3.1}, 0.29),
        ({"a": -3.1}, 0.31),  # across half a turn
    ]
    before, *after = states(store, *told)
    path = WRITERS[writer](tmp_path, [before, *clouds(store), *after])
    assert {frame.joints for frame in open_stream(path)} == {None}
    for topic in (None, "/joint_states"):
        asked = Joints(topic, names=("a", "b"))
        frames, lines = lines_of(stream := open_stream(path, joints=asked))
        first, second, third, last = told_joints(frames)
        assert first == {"a": 1.0, "b": 2.0} and third is None
        assert second == {"a": pytest.approx(3.5), "b": 3.0}
        assert last == {"a": pytest.approx(np.pi), "b": 6.0}
        assert [f.joints and f.joints["skew"] for f in frames] == [0, 0.02, None, 0.01]
        assert stream.skew == {"seconds": 0.02, "metres": pytest.approx(0.005)}
        assert stream.remarks == {"joints": 1}
        (line,) = lines
        assert "robot unknown in frame 2: no joint positions within 0.12 s" in line
    # A joint that is not needed is not missed.
    for asked, wanted in [
        (Joints(names=("a", "c")), {"a": 4.0}),
        (Joints(gap=0.21), {"a": 4.0, "b": 4.5}),
    ]:
        _, _, third, _ = told_joints(open_stream(path, joints=asked))
        assert third == pytest.approx(wanted)
    base = np.eye(4).tolist()
    stream = open_stream(path, joints=Joints(given={"positions": {}}, base=base))
    assert [f.joints for f in stream] == 4 * [{"positions": {}, "base": base}]
    with pytest.raises(InputError, match="set --joints to one of /joint_states"):
        open_stream(path, joints=Joints("/arm"))


@pytest.mark.parametrize("joints_first", [False, True])
def test_joints_of_another_time_are_not_used(joints_first, tmp_path):
    """The clocks go back by five seconds, in any order, while a frame still waits."""
    frames = [cloud(CLOUDS[0], START + n * SECOND // 10) for n in (50, 100, 101, 50)]
    frames = [("/p", CLOUD, 0, message) for message in frames]
    early = states(ROS2, ({"a": 5.0}, 4.98), ({"a": 5.0}, 5.02))
    late = states(ROS2, ({"a": 9.0}, 9.98), ({"a": 9.0}, 10.02))
    anew = states(ROS2, *(({"a": 7.0}, after) for after in (4.99, 5.01, 10.0, 10.1)))
    told = [early[0], frames[0], early[1], late[0], frames[1], late[1], frames[2]]
    told += [frames[3], *anew]
    if joints_first:
        told[7:9] = anew[0], frames[3]
    path = write_mcap(tmp_path / "r.mcap", told)
    found = told_joints(lines_of(open_stream(path, joints=Joints()))[0])
    assert found == [{"a": 5.0}, {"a": 9.0}, None, {"a": 7.0}]


def test_joints_that_never_come_are_told_once_and_counted(tmp_path):
    """And no more than some frames wait for them."""
    odd = joints({"a": 1.0}, START)
    odd.name.append("b")
    told = [({"a": 1.0}, after) for after in (0.0, 0.05, 0.15, 2.35, 2.45)]
    first, *late = states(ROS2, *told)
    many = [cloud(CLOUDS[0], START + n * SECOND // 10) for n in range(25)]
    many = [("/p", CLOUD, 0, message) for message in many]
    messages = [("/joint_states", JOINTS, 0, odd), first, *many, *late]
    stream = open_stream(write_mcap(tmp_path / "r.mcap", messages), joints=Joints())
    frames, lines = lines_of(stream)
    assert told_joints(frames) == [{"a": 1.0}, *23 * [None], {"a": 1.0}]
    assert "2 joints have 1 positions" in lines[0] and "in frame 1" in lines[1]
    (tmp_path / "none").mkdir()
    path = write_mcap(tmp_path / "none" / "r.mcap", clouds(ROS2))
    with pytest.raises(InputError, match="no joint positions"):
        open_stream(path, joints=Joints())
