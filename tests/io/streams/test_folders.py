"""Folders of clouds, of depth images, and of recordings."""

import json
import pathlib
import shutil

import numpy as np
import pytest
from PIL import Image

from prism_jax.assets import asset
from prism_jax.data.recordings import RecordedCells
from prism_jax.io.depth import camera_to_dict, read_depth
from prism_jax.io.errors import InputError
from prism_jax.io.ply import ply_bytes
from prism_jax.io.scan import read_scan
from prism_jax.io.streams import Joints, open_stream

POINTS = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)


def test_clouds_by_the_numbers_in_their_names(tmp_path):
    for number in (10, 9, 100):
        (tmp_path / f"scan{number}.ply").write_bytes(ply_bytes(POINTS + number))
    np.save(tmp_path / "scan11.npy", POINTS + 11)
    (tmp_path / "notes.md").write_text("is not a cloud")
    stream = open_stream(tmp_path)
    assert len(stream) == 4
    frames = list(stream)
    for frame, number in zip(frames, (9, 10, 11, 100), strict=True):
        np.testing.assert_array_equal(frame.points, POINTS + number)
        assert frame.points.dtype == np.float32
    assert [frame.timestamp for frame in frames] == [0, 10**8, 2 * 10**8, 3 * 10**8]


def test_a_cut_file_is_left_out_with_a_line(tmp_path):
    spoilt = POINTS.copy()
    spoilt[:5], spoilt[5:9] = np.nan, 0.0
    for number, points in enumerate((POINTS, POINTS, POINTS, spoilt)):
        (tmp_path / f"{number}.ply").write_bytes(ply_bytes(points))
    path = tmp_path / "1.ply"
    path.write_bytes(path.read_bytes()[:-10])
    lines = []
    stream = open_stream(tmp_path, tell=lines.append)
    assert [f.num_not_finite for f in stream] == [0, 0, 9]
    assert "skipped 1.ply" in lines[0] and "4 of 100 points are at 0,0,0" in lines[1]
    assert stream.remarks == {"damaged": 1, "no_return": 1}


def test_depth_images_are_those_of_a_scan(tmp_path):
    source = asset("roboarm") / "000-panda" / "000000"
    image, about = (f"{source}.{name}" for name in ("depth.png", "camera.json"))
    for number in range(2):
        shutil.copy(image, tmp_path / f"{number}.png")
    shutil.copy(about, tmp_path / "camera.json")
    frames = list(open_stream(tmp_path))
    scan = read_scan(image, about)
    for frame in frames:
        np.testing.assert_array_equal(frame.points, scan.points)
        assert camera_to_dict(frame.camera) == camera_to_dict(scan.camera)
    depth, mask, _ = read_depth(image, about)
    np.testing.assert_array_equal(frames[0].depth, np.where(mask, depth, 0))
    # Its own camera goes first.
    other = json.loads(pathlib.Path(about).read_text()) | {"depth_scale": 0.001}
    (tmp_path / "1.json").write_text(json.dumps(other))
    first, second = open_stream(tmp_path)
    np.testing.assert_allclose(second.depth, 4 * first.depth)
    (tmp_path / "camera.json").rename(tmp_path / "given")
    for frame in open_stream(tmp_path, camera=str(tmp_path / "given")):
        np.testing.assert_array_equal(frame.points, scan.points)


def test_depth_images_of_data_sets(tmp_path):
    """TUM RGB-D lists times, 7-Scenes has poses; both know their counts."""
    camera = {"width": 4, "height": 2, "fx": 4.0, "fy": 4.0, "cx": 1.5, "cy": 0.5}
    given, tum, scenes = (tmp_path / name for name in ("c.json", "tum", "scenes"))
    given.write_text(json.dumps(camera))
    (tum / "depth").mkdir(parents=True)
    scenes.mkdir()
    image = Image.fromarray(np.array([[65535, *3 * [5000]], 4 * [5000]], np.uint16))
    for path in (
        tum / "depth" / "1",
        scenes / "frame-0.depth",
        scenes / "frame-1.depth",
    ):
        image.save(f"{path}.png")
    listed = (
        "# times and names\n1.1 rgb/1.png 1305031102.160407 depth/1.png\nnonsense\n"
    )
    (tum / "associations.txt").write_text(listed)
    pose = [[0, 0, 1, 7], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    np.savetxt(scenes / "frame-0.pose.txt", pose)
    np.savetxt(scenes / "frame-1.pose.txt", np.full((4, 4), np.nan))
    asked = {"camera": str(given), "tell": lambda _: None}
    (frame,) = stream = open_stream(tum, **asked)
    assert frame.timestamp == 1305031102_160407000 and frame.depth.max() == 1.0
    assert stream.remarks == {"damaged": 1, "layout": 1, "no_return": 1}
    assert "read as TUM RGB-D, 5000 counts a metre" in stream.told["layout"]
    (frame,) = stream = open_stream(scenes, **asked)
    np.testing.assert_allclose(frame.points[:, 0], 12.0)  # ahead is the world's x
    assert "not a pose: rotation must be 3x3 finite" in stream.told["damaged"]
    given.write_text(json.dumps(camera | {"depth_scale": 0.0001}))
    assert next(iter(open_stream(tum, **asked))).depth.max() == 0.5


def test_recordings_have_two_topics():
    root = asset("roboarm")
    with pytest.raises(InputError, match="set --topic to one of depth, partial"):
        open_stream(root)
    cells = RecordedCells(root)
    (partial,) = open_stream(root, "partial")
    np.testing.assert_array_equal(partial.points, cells[0].partial)
    (depth,) = open_stream(root, "depth")
    frame = cells.read(0)
    np.testing.assert_array_equal(
        np.rint(depth.depth / 0.00025).astype(np.uint16), frame.depth
    )
    assert camera_to_dict(depth.camera) == camera_to_dict(partial.camera)
    # One of its sequences is a recording, too.
    (again,) = open_stream(root / "000-panda", "depth")
    np.testing.assert_array_equal(again.points, depth.points)


def test_what_cannot_be_a_stream_is_one_line(tmp_path):
    with pytest.raises(InputError, match="no frames in this folder"):
        open_stream(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        open_stream(tmp_path / "no.bag")
    (tmp_path / "scan.ply").write_bytes(ply_bytes(POINTS))
    with pytest.raises(InputError, match=r"suffix '.ply' is not a recording"):
        open_stream(tmp_path / "scan.ply")
    with pytest.raises(InputError, match="omit --topic"):
        open_stream(tmp_path, "/points")
    Image.fromarray(np.ones((4, 4), np.uint16)).save(tmp_path / "depth.png")
    with pytest.raises(InputError, match="folder mixes 1 clouds and 1 images"):
        open_stream(tmp_path)


def test_recordings_tell_their_joints_if_asked(tmp_path):
    root = asset("roboarm")
    wanted = RecordedCells(root).read(0).joints
    for topic in ("depth", "partial"):
        (frame,) = open_stream(root, topic, joints=Joints())
        assert frame.joints == wanted
        (frame,) = open_stream(root, topic)
        assert frame.joints is None
    copied = tmp_path / "cells"
    shutil.copytree(root, copied)
    (file,) = copied.glob("*/*.joints.json")
    file.unlink()
    stream = open_stream(copied, "depth", tell=lambda _: None, joints=Joints())
    assert [frame.joints for frame in stream] == [None]
    assert stream.remarks == {"joints": 1}
    with pytest.raises(InputError, match="omit --joints"):
        open_stream(root, "depth", joints=Joints("/joint_states"))
    (tmp_path / "scan.ply").write_bytes(ply_bytes(POINTS))
    with pytest.raises(InputError, match=r"set --joints to a \.json"):
        open_stream(tmp_path, joints=Joints())
