"""NumPy's own files."""

import io
import struct
import zipfile

import numpy as np
import pytest

from prism_jax.io import InputError
from prism_jax.io.arrays import read_npy, read_npz

POINTS = np.random.default_rng(0).normal(size=(50, 3)) * 100


@pytest.mark.parametrize("order", ["C", "F"])
def test_values_come_back_exactly(tmp_path, order):
    for dtype in ("<f4", ">f4", "<f8", ">f8", "<f2", "<i2", "u1"):
        stored = np.abs(POINTS).astype(dtype, order=order)
        np.save(tmp_path / "a.npy", stored)
        read = read_npy(tmp_path / "a.npy")
        assert read.dtype == (np.float32 if "f4" in dtype else np.float64)
        np.testing.assert_array_equal(read, stored)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_archive(tmp_path, save):
    objects = np.array([Bomb()], dtype=object)  # which stay pickled
    others = {"range_mm": np.zeros((4, 8)), "angles": np.zeros(8), "meta": objects}
    for key in ("xyz", "points", "anything"):
        save(tmp_path / "a.npz", **others, **{key: POINTS})
        np.testing.assert_array_equal(read_npz(tmp_path / "a.npz"), POINTS)
    save(tmp_path / "a.npz", normals=POINTS, xyz=POINTS + 1, points=POINTS + 2)
    fields = {}
    read = read_npz(tmp_path / "a.npz", fields=fields)
    np.testing.assert_array_equal(read, POINTS + 1)
    assert [*fields] == ["nx", "ny", "nz", "points_0", "points_1", "points_2"]
    many = {"xyz": POINTS, "rgb": np.asfortranarray(POINTS), "ring": POINTS[:, :1]}
    save(tmp_path / "a.npz", **many, time=POINTS[:, 1], names=POINTS.astype("U3"))
    read_npz(tmp_path / "a.npz", fields=(fields := {}))
    assert [*fields] == ["red", "green", "blue", "ring", "time"]
    wanted = np.hstack([POINTS, POINTS[:, :2]])
    np.testing.assert_array_equal(np.stack([*fields.values()], axis=1), wanted)


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_shapes_and_fields_that_hold_positions(tmp_path, name):
    read = {"a.npy": read_npy, "a.npz": read_npz}[name]
    fields = [("i", "u2"), ("z", "<f4"), ("x", "<f4"), ("y", ">f4")]
    table = np.zeros((10, 5), fields)
    for axis, column in zip("xyz", POINTS.T, strict=True):
        table[axis] = column.reshape(10, 5)
    image = POINTS.reshape(10, 5, 3)
    for array in (image, np.asfortranarray(image), table, table.ravel()):
        (np.save if name == "a.npy" else np.savez)(tmp_path / name, array)
        found = {}
        points = read(tmp_path / name, fields=found)
        np.testing.assert_array_equal(points, POINTS.astype(points.dtype))
        assert [*found] == ["i"] * (array.dtype.names is not None)
        assert points.dtype == (np.float32 if array.dtype.names else np.float64)


def npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def claim(shape) -> bytes:
    """A header without the numbers it promises."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


class Bomb:
    """Fails the test if it is ever unpickled."""

    def __reduce__(self):
        return pytest.fail, ("unpickled",)


FAULTS = [
    (npy(POINTS)[:-1], "the file is truncated"),
    (npy(POINTS)[:9], "damaged"),
    (b"not numpy", "magic"),
    (claim("(1000000, 3)"), "the file is truncated"),
    (claim("(True, 3)"), "damaged header"),
    (claim("(" * 3000), "header"),
    (claim("'\\h'"), "header"),
    (claim("(-5, 3)"), "shape"),
    (npy(POINTS[:0]), r"shape \(0, 3\)"),
    (npy(POINTS.T), r"shape \(3, 50\)"),
    (npy(POINTS.astype(complex)), "complex128"),
    (npy(POINTS.astype("U5")), "type <U5"),
    (npy(np.array([[Bomb()] * 3], dtype=object)), "object"),
    (b"\x93NUMPY\x03\x00" + bytes(99), "version"),
]


def test_malformed_array(tmp_path, recwarn):
    for data, fault in FAULTS:
        (tmp_path / "a.npy").write_bytes(data)
        with pytest.raises(InputError, match=f"{fault}.*numpy.save"):
            read_npy(tmp_path / "a.npy")
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("xyz.npy", data)
        with pytest.raises(InputError):
            read_npz(tmp_path / "a.npz")
    assert not recwarn.list


def test_archive_without_a_cloud_or_with_a_choice_of_them(tmp_path):
    np.savez(tmp_path / "a.npz", scan=POINTS, complete=POINTS)
    with pytest.raises(InputError, match="could be the cloud: scan, complete"):
        read_npz(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", depth=np.zeros((4, 8)))
    with pytest.raises(InputError, match=r"depth: an array of shape \(4, 8\)"):
        read_npz(tmp_path / "a.npz")


def test_damaged_archive(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", xyz=POINTS)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    for broken in (data[:100], b"PK\x05\x06" + bytes(18), data[:200] + data[230:]):
        (tmp_path / "a.npz").write_bytes(broken)
        with pytest.raises(InputError, match="not a valid NPZ"):
            read_npz(tmp_path / "a.npz")


def test_a_member_that_is_not_named_npy(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("xyz", npy(POINTS))
    np.testing.assert_array_equal(read_npz(tmp_path / "a.npz"), POINTS)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[60:90] = bytes(30)
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(InputError, match="not a valid NPZ cloud"):
        read_npz(tmp_path / "a.npz")
