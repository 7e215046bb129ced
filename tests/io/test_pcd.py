"""PCD files, by hand."""

import struct

import lzf
import numpy as np
import pytest

from prism_jax.io import InputError
from prism_jax.io.pcd import read_pcd, read_pcd_field

POINTS = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
ROW = np.dtype(
    [("label", "<u4"), ("z", "<f4"), ("_", "u1", 3), ("x", "<f4"), ("y", "<f4")]
)
HEADER = """# .PCD v0.7
VERSION 0.7
FIELDS label z _ x y
SIZE 4 4 1 4 4
TYPE U F U F F
COUNT 1 1 3 1 1
WIDTH 3
HEIGHT 2
VIEWPOINT 1 2 3 1 0 0 0
POINTS 6
DATA {}
"""


def rows(points=POINTS):
    table = np.zeros(len(points), ROW)
    table["label"], table["_"] = 7, 255
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    return table


def body(mode: str, points=POINTS) -> bytes:
    table = rows(points)
    if mode == "ascii":
        lines = [
            f"7 {float(z)!r} 255 255  255\t{float(x)!r} {float(y)!r}"
            for x, y, z in points
        ]
        return "\r\n".join(lines).encode()
    if mode == "binary":
        return table.tobytes()
    plain = b"".join(table[name].tobytes() for name in ROW.names)
    packed = lzf.compress(plain, 2 * len(plain))
    return struct.pack("<II", len(packed), len(plain)) + packed


def pcd(tmp_path, mode: str, data: bytes | None = None, header: str = HEADER):
    path = tmp_path / "a.pcd"
    path.write_bytes(header.format(mode).encode() + (data or body(mode)))
    return path


MODES = ["ascii", "binary", "binary_compressed"]


@pytest.mark.parametrize("mode", MODES)
def test_fields_in_any_order_type_and_count(tmp_path, mode):
    read = read_pcd(pcd(tmp_path, mode))
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, POINTS)


@pytest.mark.parametrize("mode", MODES)
def test_one_more_field_of_every_point(tmp_path, mode):
    path = pcd(tmp_path, mode)
    np.testing.assert_array_equal(read_pcd_field(path, "label"), np.full(6, 7))
    for name in ("colour", "_"):
        with pytest.raises(InputError, match=f"not {name}"):
            read_pcd_field(path, name)


@pytest.mark.parametrize("mode", MODES)
def test_points_that_saw_nothing_are_kept_as_they_are(tmp_path, mode):
    points = POINTS.copy()
    points[2] = np.nan
    np.testing.assert_array_equal(
        read_pcd(pcd(tmp_path, mode, body(mode, points))), points
    )


def test_compressed_bytes_written_by_hand(tmp_path):
    # LZF: 0x03 is four literal bytes; 0x20 n + 0x03 repeats seven from four back.
    one = np.float32(1).tobytes()
    packed = b"\x03" + one + b"\xe0\x17\x03"
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 3\nDATA {}\n"
    data = struct.pack("<II", len(packed), 36) + packed
    path = pcd(tmp_path, "binary_compressed", data, header)
    np.testing.assert_array_equal(read_pcd(path), np.ones((3, 3)))


@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_old_version_without_count_and_double_coordinates(tmp_path, mode):
    header = """VERSION .5
FIELDS x y z
SIZE 8 8 8
TYPE F F F
POINTS 6
DATA {}
"""
    points = POINTS.astype(np.float64) + 1e6
    data = points.tobytes()
    if mode == "ascii":
        data = "\n".join(" ".join(map(repr, p)) for p in points.tolist()).encode()
    read = read_pcd(pcd(tmp_path, mode, data, header))
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, points)


def test_agrees_with_open3d(tmp_path):
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    for text, compressed in ((True, False), (False, False), (False, True)):
        path = str(tmp_path / "o.pcd")
        o3d.io.write_point_cloud(path, cloud, write_ascii=text, compressed=compressed)
        np.testing.assert_allclose(read_pcd(path), POINTS, rtol=1e-6)


def replaced(old: str, new: str) -> str:
    assert old in HEADER
    return HEADER.replace(old, new)


PACKED = body("binary_compressed")
FAULTS = [
    ("no DATA line", "binary", HEADER.replace("DATA {}\n", ""), b"x"),
    ("mode 'zip' is unknown", "zip", HEADER, b"x"),
    ("differ in length", "binary", replaced("COUNT 1 1 3 1 1", "COUNT 1"), None),
    ("differ in length", "binary", replaced("SIZE 4 4 1 4 4\n", ""), None),
    ("'z' has an unknown type", "binary", replaced("U F U F F", "U Q U F F"), None),
    ("'z' has an unknown type", "binary", replaced("E 4 4 1", "E 4 3 1"), None),
    ("invalid literal", "binary", replaced("E 4 4 1", "E 4 four 1"), None),
    ("not x y z", "binary", replaced(" x y", " a b"), None),
    ("not x y z", "binary", replaced("COUNT 1 1", "COUNT 1 2"), None),
    (
        "invalid count",
        "binary",
        replaced("COUNT 1 1 3", "COUNT 1 1 " + "9" * 30),
        None,
    ),
    (
        "invalid count",
        "ascii",
        replaced("COUNT 1 1 3", "COUNT 1 1 " + "9" * 30),
        None,
    ),
    ("invalid count", "binary", replaced("COUNT 1 1 3", "COUNT 1 1 -3"), None),
    ("4300 digits", "binary", replaced("COUNT 1 1 3", "COUNT 1 1 " + "9" * 5000), None),
    ("WIDTH x HEIGHT", "binary", replaced("POINTS 6", "POINTS 7"), None),
    ("WIDTH x HEIGHT", "binary", replaced("WIDTH 3", "WIDTH -3"), None),
    ("no points", "binary", replaced("WIDTH 3", "WIDTH 0").replace("S 6", "S 0"), b"x"),
    ("the file is truncated", "binary", HEADER, body("binary")[:-1]),
    ("the file is truncated", "binary_compressed", HEADER, b"123"),
    ("the file is truncated", "binary_compressed", HEADER, PACKED[:-1]),
    (
        "compressed size differs",
        "binary_compressed",
        HEADER,
        struct.pack("<II", 4, 7) + b"1234",
    ),
    ("damaged", "binary_compressed", HEADER, PACKED[:8] + b"\xff" * (len(PACKED) - 8)),
    ("ends after 5 of 6", "ascii", HEADER, body("ascii", POINTS[:5])),
    ("column", "ascii", HEADER, b"1 2 3 4\n" * 6),
]


@pytest.mark.parametrize(("fault", "mode", "header", "data"), FAULTS)
def test_malformed_file_is_one_line(tmp_path, fault, mode, header, data):
    with pytest.raises(InputError) as caught:
        read_pcd(pcd(tmp_path, mode, data or body("binary"), header))
    assert fault in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "export it again" in str(caught.value)


@pytest.mark.parametrize("mode", MODES)
def test_huge_claim_costs_nothing(tmp_path, mode):
    huge = str(10**15)
    header = HEADER.replace("WIDTH 3", f"WIDTH {huge}").replace("HEIGHT 2", "HEIGHT 1")
    header = header.replace("POINTS 6", f"POINTS {huge}")
    with pytest.raises(InputError):
        read_pcd(pcd(tmp_path, mode, header=header))


def test_compressed_size_that_no_data_can_unpack_to(tmp_path):
    header = HEADER.replace("WIDTH 3", f"WIDTH {10**6}").replace("HEIGHT 2", "HEIGHT 1")
    header = header.replace("POINTS 6", f"POINTS {10**6}")
    data = struct.pack("<II", 4, 19 * 10**6) + b"1234"
    with pytest.raises(InputError, match="compressed size differs"):
        read_pcd(pcd(tmp_path, "binary_compressed", data, header))


def test_organised_frame_of_a_depth_camera(real):
    points = read_pcd(real("kinect/mosd_test24.pcd"))
    assert points.shape == (640 * 480, 3)
    assert np.isfinite(points).all(axis=1).sum() == 185_257
