"""Cameras as JSON, and depth images."""

import functools
import io
import json
import warnings

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from prism_jax.geometry.camera import Camera
from prism_jax.io import (
    InputError,
    camera_from_dict,
    camera_to_dict,
    points_from_depth,
    read_camera,
    read_depth,
)

PINHOLE = {"width": 8, "height": 6, "fx": 10.0, "fy": 11.0, "cx": 3.5, "cy": 2.5}
COUNTS = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1300


NESTED = functools.reduce(lambda inner, _: [inner], range(200), 0)


def write(path, entries) -> str:
    path.write_text(json.dumps(entries))
    return str(path)


def test_camera_round_trip_is_exact():
    camera = Camera.look_at((1, 2, 3), (0, 0.5, 0), fov_degrees=50, height=7, width=9)
    again = camera_from_dict(json.loads(json.dumps(camera_to_dict(camera))))
    assert (again.height, again.width) == (7, 9)
    for name in ("rotation", "translation", "intrinsics"):
        np.testing.assert_array_equal(getattr(again, name), getattr(camera, name))


def test_pose_is_the_identity_unless_given(tmp_path):
    camera = read_camera(write(tmp_path / "c.json", {**PINHOLE, "note": "any"}))
    np.testing.assert_array_equal(camera.rotation, np.eye(3))
    np.testing.assert_array_equal(camera.translation, np.zeros(3))
    expected = [[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]]
    np.testing.assert_array_equal(camera.intrinsics, expected)


PLAIN = {"width": 8, "height": 6}
ROWS = [[10.0, 0, 3.5], [0, 11.0, 2.5], [0, 0, 1]]
FLAT, COLUMNS = np.ravel(ROWS).tolist(), np.ravel(ROWS, "F").tolist()
THEIRS = [
    PLAIN | {"fx": 10.0, "fy": 11.0, "ppx": 3.5, "ppy": 2.5},
    PLAIN | {"intrinsic_matrix": COLUMNS},
    {"intrinsic": PLAIN | {"intrinsic_matrix": COLUMNS}},
    {"image_width": 8, "image_height": 6, "camera_matrix": {"data": FLAT}},
    PLAIN | {"camera_matrix": ROWS},
    PLAIN | {"cam_K": FLAT},
]


def test_names_of_other_tools_and_what_is_not_used_is_told(tmp_path, capsys):
    wanted = camera_to_dict(camera_from_dict(PINHOLE))
    odd = {"coeffs": [0, 0.1], "D": {"rows": 1, "data": [0, 0]}, "extrinsic": ROWS}
    for entries in THEIRS:
        camera = read_camera(write(tmp_path / "c.json", entries | odd))
        assert camera_to_dict(camera) == wanted
        lens, pose = capsys.readouterr().err.splitlines()
        assert lens.endswith("c.json: coeffs is lens distortion, which is not undone")
        assert "extrinsic is not used" in pose


YAML = """image_width: 8
image_height: 6
camera_matrix: {}
  rows: 3
  data: [1.e+1, 0, 3.5, 0., 1.1e+01, 2.5, 0., 0., 1]
distortion_model: type_9
distortion_coefficients: {{data: [0, 1e-05]}}
"""
ECHO = f"width: 8\nheight: 6\nd: [1e-05]\nk: {FLAT}\n---\nwidth: 9\n"
YAMLS = YAML.format(""), "%YAML:1.0\n---\n" + YAML.format("!!opencv-matrix"), ECHO
BOMB = "a: &a [0]\nb: &b [*a, *a]\nc: [*b, *b]\n"


def test_cameras_of_ros_and_opencv_in_yaml(tmp_path):
    wanted, path = camera_to_dict(camera_from_dict(PINHOLE)), tmp_path / "c.yaml"
    for text in YAMLS:
        path.write_text(text)
        lines = []
        assert camera_to_dict(read_camera(path, lines.append)) == wanted
        assert len(lines) == 1 and "lens distortion, which is not undone" in lines[0]
    unsafe = "!!python/object:os.system {}"
    for text in (BOMB, "a: [", "- 1", unsafe, "#" * 2**17, "- " * 30_000):
        path.write_text(text)
        with pytest.raises(InputError, match=r"not (a )?YAML.*\"fx\":"):
            read_camera(path)


FAULTS = [
    ({"cam_K": [1, 2, 3]}, "cam_K must be 9"),
    ({"width": None}, "width is missing"),
    ({"width": 0}, "an integer"),
    ({"height": 2.5}, "an integer"),
    ({"height": 10**9}, "an integer"),
    ({"fx": 0}, "positive"),
    ({"cx": "3"}, "cx is missing or not a finite number"),
    ({"cy": True}, "cy is missing or not a finite number"),
    ({"cx": 10**400}, "cx is missing or not a finite number"),
    ({"rotation": [[1, 0], [0, 1]]}, "3x3"),
    ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "orthogonal"),
    ({"rotation": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "reflection"),
    ({"translation": [0, 0]}, "translation must be 3"),
    ({"translation": [0, 0, float("inf")]}, "translation must be 3"),
    ({"translation": [10**400, 0, 0]}, "translation must be 3"),
    ({"translation": [{}, [], 0]}, "translation must be 3"),
    ({"translation": [True, True, True]}, "translation must be 3"),
    ({"rotation": [[1e8, 0, 0], [0, 1e8, 0], [0, 0, 1e8]]}, "orthogonal"),
]  # fmt: skip


def test_malformed_camera(tmp_path):
    for change, fault in FAULTS:
        with pytest.raises(InputError, match=f'{fault}.*"fx":'):
            read_camera(write(tmp_path / "c.json", PINHOLE | change))
    for data in (
        b"",
        b"[1]",
        b"\xff",
        b'{"fx":' + b"[" * 100_000,
        b'{"fx": 1' + b"0" * 10_000 + b"}",
        json.dumps(PINHOLE | {"translation": NESTED}).encode(),
    ):
        (tmp_path / "c.json").write_bytes(data)
        with pytest.raises(InputError, match=r"camera|empty"):
            read_camera(tmp_path / "c.json")


def test_depth_image(tmp_path):
    Image.fromarray(COUNTS).save(tmp_path / "d.png")
    camera_path = write(tmp_path / "c.json", {**PINHOLE, "depth_scale": 0.00025})
    depth, mask, camera = read_depth(tmp_path / "d.png", camera_path)
    np.testing.assert_allclose(depth, COUNTS * 0.00025, rtol=1e-15)
    np.testing.assert_array_equal(mask, COUNTS > 0)
    assert camera.width == 8


def test_points_project_back_to_their_pixels():
    turn = Rotation.from_rotvec([1, 2, 3]).as_matrix().tolist()
    camera = camera_from_dict(PINHOLE | {"rotation": turn, "translation": [3, 2, 1]})
    depth, mask = COUNTS * 0.00025, COUNTS > 0
    points = points_from_depth(depth, mask, camera)
    assert points.dtype == np.float64
    pixels, z = camera.project(points.astype(np.float32))
    rows, columns = np.nonzero(mask)
    np.testing.assert_allclose(pixels, np.stack([columns, rows], 1), atol=1e-4)
    np.testing.assert_allclose(z, depth[mask], rtol=1e-5)


def test_depth_scale_is_needed(tmp_path):
    Image.fromarray(COUNTS).save(tmp_path / "d.png")
    for entries in (PINHOLE, PINHOLE | {"depth_scale": 0}):
        camera_path = write(tmp_path / "c.json", entries)
        with pytest.raises(InputError, match="metres per count"):
            read_depth(tmp_path / "d.png", camera_path)


def packed(pixels, kind="PNG"):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind)
    return buffer.getvalue()


def test_image_that_is_no_depth(tmp_path):
    sound = packed(COUNTS)
    wide = (8).to_bytes(4, "big"), (2**30).to_bytes(4, "big"), 1
    camera_path = write(tmp_path / "c.json", {**PINHOLE, "depth_scale": 0.001})
    for data in (
        packed(COUNTS.astype(np.uint8)),
        packed(np.zeros((6, 8, 3), np.uint8)),
        packed(COUNTS[:, :7].copy()),
        packed(COUNTS, "TIFF"),
        sound[:-30],
        sound.replace(*wide),
        b"PNG?",
    ):
        (tmp_path / "d.png").write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(InputError, match="not a valid depth image"):
                read_depth(tmp_path / "d.png", camera_path)
