"""PCD files, by hand."""

import re
import struct

import lzf
import numpy as np
import pytest

from prism_jax.io import InputError
from prism_jax.io.pcd import read_pcd, read_viewpoint

POINTS = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
ROW = np.dtype(
    [("label", "<u4"), ("_", "u1", 3), ("z", "<f4"), ("x", "<f4"), ("y", "<f4")]
)
HEADER = """# .PCD v0.7
VERSION 0.7
FIELDS label _ z x y
SIZE 4 1 4 4 4
TYPE U U F F F
COUNT 1 3 1 1 1
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
            f"7 255 255  255\t{float(z)!r} {float(x)!r} {float(y)!r}"
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
    points = POINTS.copy()
    points[2] = np.nan
    path = pcd(tmp_path, mode, body(mode, points))
    fields = {}
    read = read_pcd(path, fields=fields)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, points)
    assert [*fields] == ["label"]
    np.testing.assert_array_equal(fields["label"], np.full(6, 7, np.uint32))


@pytest.mark.parametrize("mode", MODES)
def test_small_letters_lone_crs_odd_types_and_spellings(tmp_path, mode):
    points, header = POINTS.copy(), replaced("U U F F F", "u X f f f")
    points[:3, 0] = np.nan
    data = body(mode, points)
    if mode == "ascii":
        for spelling in (b"-1.#IND", b"1.#QNAN", b"-nan(ind)"):
            data = data.replace(b" nan", b" " + spelling, 1)
    header = header.replace("\n", "\r")
    np.testing.assert_array_equal(read_pcd(pcd(tmp_path, mode, data, header)), points)


def test_where_the_sensor_stood(tmp_path):
    eye = read_viewpoint(pcd(tmp_path, "binary"))
    assert eye is not None and eye.tolist() == [1, 2, 3]
    nothing = "0 0 0 1 0 0 0", "-0.0 0 0 0.5 0 0 0.8", "nan 0 0 1 0 0 0", "", "1 a 3"
    for said in nothing:
        header = replaced("VIEWPOINT 1 2 3 1 0 0 0", f"VIEWPOINT {said}")
        assert read_viewpoint(pcd(tmp_path, "binary", header=header)) is None


def test_old_version_without_count_and_double_coordinates(tmp_path):
    header = "VERSION .5\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 6\nDATA {}\n"
    points = POINTS.astype(np.float64) + 1e6
    text = "\n".join(" ".join(map(repr, p)) for p in points.tolist())
    for mode, data in (("ascii", text.encode()), ("binary", points.tobytes())):
        read = read_pcd(pcd(tmp_path, mode, data, header))
        assert read.dtype == np.float64
        np.testing.assert_array_equal(read, points)


def replaced(old: str, new: str) -> str:
    assert old in HEADER
    return HEADER.replace(old, new)


COUNT = "COUNT 1 3 1 1 1"
BINARY_FAULTS = [
    ("no DATA line", HEADER.replace("DATA {}\n", "")),
    ("differ in length", replaced(COUNT, "COUNT 1")),
    ("differ in length", replaced("SIZE 4 1 4 4 4\n", "")),
    ("'z' has an unknown type", replaced("U U F F", "U U Q F")),
    ("'z' has an unknown type", replaced("E 4 1 4", "E 4 1 3")),
    ("invalid literal", replaced("E 4 1", "E 4 one")),
    ("not x y z", replaced(" x y", " a b")),
    ("not x y z", replaced(COUNT, "COUNT 1 3 1 1 2")),
    ("invalid count", replaced(COUNT, f"COUNT 1 {'9' * 30} 1 1 1")),
    ("invalid count", replaced(COUNT, "COUNT 1 -3 1 1 1")),
    ("4300 digits", replaced(COUNT, f"COUNT 1 {'9' * 5000} 1 1 1")),
    ("WIDTH x HEIGHT", replaced("POINTS 6", "POINTS 7")),
    ("WIDTH x HEIGHT", replaced("WIDTH 3", "WIDTH -3")),
    ("no points", replaced("WIDTH 3", "WIDTH 0").replace("S 6", "S 0")),
]
PACKED = body("binary_compressed")
MILLION = HEADER.replace("WIDTH 3\nHEIGHT 2", "WIDTH 1000000\nHEIGHT 1")
MILLION = MILLION.replace("POINTS 6", "POINTS 1000000")
TOO_MUCH = struct.pack("<II", 4, 19 * 10**6) + b"1234"  # no data can unpack to that
FAULTS = [
    *((fault, "binary", header, body("binary")) for fault, header in BINARY_FAULTS),
    ("mode 'zip' is unknown", "zip", HEADER, b"x"),
    ("the file is truncated", "binary", HEADER, body("binary")[:-1]),
    ("the file is truncated", "binary_compressed", HEADER, b"123"),
    ("the file is truncated", "binary_compressed", HEADER, PACKED[:-1]),
    ("size differs", "binary_compressed", HEADER, struct.pack("<II", 4, 7) + b"1234"),
    ("damaged", "binary_compressed", HEADER, PACKED[:8] + b"\xff" * (len(PACKED) - 8)),
    ("ends after 5 of 6", "ascii", HEADER, body("ascii", POINTS[:5])),
    ("column", "ascii", HEADER, b"1 2 3 4\n" * 6),
    ("size differs", "binary_compressed", MILLION, TOO_MUCH),
]


def test_malformed_file(tmp_path):
    for fault, mode, header, data in FAULTS:
        with pytest.raises(InputError, match=f"{re.escape(fault)}.*export it again"):
            read_pcd(pcd(tmp_path, mode, data, header))
