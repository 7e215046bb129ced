"""PLY files, by trimesh and by hand."""

import re
import struct

import numpy as np
import plyfile
import pytest
import trimesh

from prism_jax.io import InputError
from prism_jax.io.ply import COLORS, ply_bytes, read_ply

POINTS = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(tmp_path, layout: str, header: str, body: bytes):
    path = tmp_path / "a.ply"
    text = f"ply\nformat {layout} 1.0\ncomment by hand\n{header}end_header\n"
    path.write_bytes(text.encode() + body)
    return path


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_reads_what_plyfile_writes_with_a_range_grid(tmp_path, text, order):
    grid = np.zeros(4, dtype=[("vertex_indices", object), ("flag", "u2")])
    grid["vertex_indices"] = [np.arange(n, dtype=np.int32) for n in (0, 1, 3, 0)]
    lengths = {"vertex_indices": "u2"}
    grid = plyfile.PlyElement.describe(grid, "range_grid", len_types=lengths)
    rows = POINTS.view([("x", "f4"), ("y", "f4"), ("z", "f4")]).reshape(-1)
    vertex = plyfile.PlyElement.describe(rows, "vertex")
    for elements in ([grid, vertex], [vertex, grid]):
        path = tmp_path / "a.ply"
        plyfile.PlyData(elements, text=text, byte_order=order).write(path)
        np.testing.assert_allclose(read_ply(path), POINTS, rtol=1e-6)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("scalar", ["float", "double", "short"])
def test_binary_values_come_back_bit_for_bit(tmp_path, order, scalar):
    code = {"float": "f4", "double": "f8", "short": "i2"}[scalar]
    stored = (POINTS * 1000).astype(order + code)
    rows = np.zeros(100, [("q", "u1"), *((axis, stored.dtype) for axis in "yxz")])
    for axis, name in enumerate("xyz"):
        rows[name] = stored[:, axis]
    name = {"<": "little", ">": "big"}[order]
    header = "element vertex 100\nproperty uchar q\n"
    header += "".join(f"property {scalar} {axis}\n" for axis in "yxz")
    path = ply(tmp_path, f"binary_{name}_endian", header, rows.tobytes())
    read = read_ply(path)
    assert read.dtype == (np.float32 if scalar == "float" else np.float64)
    np.testing.assert_array_equal(read, stored)


def test_keeps_points_that_are_not_finite(tmp_path):
    path = ply(tmp_path, "ascii", f"element vertex 2\n{XYZ}", b"nan 0 inf\n1 2 1e99\n")
    expected = np.array([[np.nan, 0, np.inf], [1, 2, np.inf]], np.float32)
    np.testing.assert_array_equal(read_ply(path), expected)


def test_no_other_field_spoils_the_positions(tmp_path):
    """Lists, odd types, names twice, NaN as C libraries write it, and lone CRs."""
    odd = "property list uint float64 d\nproperty bool b\nproperty int64 i\n"
    header = f"element vertex 2\n{odd}property float x\nproperty float y\n"
    header += "property list uchar short e\nproperty float z\nproperty ulong i\n"
    expected, body = np.array([[1, 2, 3], [4, np.nan, 6]], np.float32), b""
    for count, (x, y, z) in enumerate(expected):
        body += struct.pack(f"<I{count}d?qff", count, *[0.5] * count, True, -1, x, y)
        body += struct.pack("<BhfQ", 1, 7, z, 2**63)
    np.testing.assert_array_equal(
        read_ply(ply(tmp_path, BINARY, header, body)), expected
    )
    text = b"0 1 -1 1 2 1 7 3 9\n1 0.5 1 -1 4 -nan(ind) 1 7 6 9\n"
    header = header.replace("ulong", "quad")
    path = ply(tmp_path, "ascii", header, text)
    np.testing.assert_array_equal(read_ply(path), expected)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r"))
    np.testing.assert_array_equal(read_ply(path), expected)


BINARY = "binary_little_endian"
VERTEX = f"element vertex 1\n{XYZ}"
GRID = "element grid 1\nproperty list {} int b\n"
LISTS = "element a 2\nproperty list uint double b\n" + VERTEX
FAULTS = [
    ("no vertices", BINARY, "element face 0\nproperty list uchar int i\n", b""),
    ("no vertices", BINARY, f"element vertex 0\n{XYZ}", b""),
    ("not x y z", BINARY, "element vertex 1\nproperty float x\n", bytes(4)),
    ("x, y, z, x, not x y z", BINARY, VERTEX + "property float x\n", bytes(16)),
    ("the file is truncated", BINARY, VERTEX + "property list int int a\n", bytes(13)),
    ("x, y or z is a list", BINARY, VERTEX.replace("float z", "list int int z"), b"0"),
    ("type 'quad'", BINARY, VERTEX + "property quad a\n", bytes(99)),
    ("line 'format binary 1.0'", "binary", VERTEX, bytes(12)),
    ("the file is truncated", BINARY, VERTEX, bytes(11)),
    ("the file is truncated", BINARY, LISTS, struct.pack("<I", 2**32 - 1) + bytes(64)),
    ("ends after 1 of 999999", "ascii", VERTEX.replace("1", "9" * 6), b"1 2 3"),
    ("line 'element vertex -1'", BINARY, "element vertex -1\n", b""),
    ("line 'property float x'", BINARY, XYZ + VERTEX, b""),
    ("line 'property list int x'", BINARY, VERTEX + "property list int x\n", b""),
    ("is not an integer", BINARY, GRID.format("float") + VERTEX, bytes(99)),
    ("negative list length", BINARY, GRID.format("char") + VERTEX, b"\xff" + bytes(99)),
    ("ends after 1 of 2", "ascii", VERTEX.replace("1", "2"), b"1 2 3\n\n\n\n"),
    ("'a'", "ascii", VERTEX, b"1 2 a\n"),
    ("column", "ascii", VERTEX, b"1 2\n"),
    ("ascii", "ascii", VERTEX, b"1 2 \xff\n"),
]


HEADERS = [
    (b"not a ply", "does not start with 'ply'"),
    (b"ply\nformat ascii 1.0\nelement vertex 1\n", "no end_header line"),
    (b"ply\n" + b"comment\n" * 2**18, "no end_header line"),
    (f"ply\nelement vertex 1\n{XYZ}end_header\n".encode(), "no format in the header"),
]


def test_malformed_file(tmp_path):
    for fault, layout, header, body in FAULTS:
        with pytest.raises(InputError, match=f"{re.escape(fault)}.*export it again"):
            read_ply(ply(tmp_path, layout, header, body))
    for data, fault in HEADERS:
        (tmp_path / "a.ply").write_bytes(data)
        with pytest.raises(InputError, match=fault):
            read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("scalar", [np.float32, np.float64])
def test_written_points_come_back_bit_for_bit(tmp_path, scalar):
    path = tmp_path / "a.ply"
    points, labels = (POINTS + np.pi * 1e5).astype(scalar), np.arange(100) >= 60
    for given in ((), (labels,)):
        path.write_bytes(ply_bytes(points, *given))
        read = read_ply(path)
        assert read.dtype == scalar
        assert read.tobytes() == points.tobytes()
        assert b"sigma" not in path.read_bytes()
    cloud = trimesh.load(path)
    np.testing.assert_array_equal(cloud.vertices, points)
    colors = np.array([COLORS[label] for label in labels.astype(int)])
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], colors)
    # With a number of an object and a sigma each, read by plyfile.
    sigma = np.where(labels, np.linspace(0, 1e-3, 100), 0.0)
    path.write_bytes(ply_bytes(points, labels, np.arange(100) - 2, sigma))
    read = plyfile.PlyData.read(path)
    assert any("sigma: expected distance" in line for line in read.comments)
    vertex = read["vertex"]
    np.testing.assert_array_equal(vertex["sigma"], sigma.astype(np.float32))
    np.testing.assert_array_equal(vertex["object"], np.arange(100) - 2)
    np.testing.assert_array_equal(vertex["label"], labels)
    assert read_ply(path).tobytes() == points.tobytes()
    # And with what the first 60 had.
    ones = np.ones(60, np.float32)
    packed = np.full(60, 0x010203, "u4").view("f4")  # as PCD and ROS have it
    had = {"rgb": packed, "nx": ones, "a b": ones.astype(int), "sigma": ones}
    path.write_bytes(ply_bytes(points, labels, None, sigma, had))
    vertex = plyfile.PlyData.read(path)["vertex"]
    assert vertex["blue"].tolist() == [3] * 60 + [0] * 40
    np.testing.assert_array_equal(vertex["nx"], [1] * 60 + [np.nan] * 40)
    np.testing.assert_array_equal(vertex["a_b"], vertex["input_sigma"])
    shades = [vertex[f"label_{name}"] for name in ("red", "green", "blue")]
    np.testing.assert_array_equal(np.stack(shades, axis=1), colors)
