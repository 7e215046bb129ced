"""LAS and LAZ files, written by laspy."""

import io
import struct
import sys
import tracemalloc

import laspy
import numpy as np
import pytest

from prism_jax.io import InputError, read_points, read_scan

POINTS = np.random.default_rng(0).uniform(0, 2, (100, 3)) + [5e5, 5.4e6, 100]
COUNT, RECORDS = 247, 100  # where the header has these numbers


def written(path, version="1.4", kind=7):
    header = laspy.LasHeader(version=version, point_format=kind)
    header.scales, header.offsets = np.full(3, 1e-3), POINTS[0].round()
    header.add_extra_dim(laspy.ExtraBytesParams("ring", np.uint8))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = POINTS.T
    cloud.intensity, cloud.red, cloud.ring = np.arange(100) * np.array([[9], [99], [1]])
    buffer = io.BytesIO()
    cloud.write(buffer, do_compress=path.suffix == ".laz")
    path.write_bytes(buffer.getvalue())
    return path


@pytest.mark.parametrize("layout", [("1.2", 3), ("1.4", 7)])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_map_coordinates_keep_millimetres_and_fields_are_kept(tmp_path, suffix, layout):
    scan = read_scan(written(tmp_path / f"a.{suffix}", *layout))
    assert scan.points.dtype == np.float64
    np.testing.assert_allclose(scan.points, POINTS, rtol=0, atol=6e-4)
    assert [*scan.fields] == ["intensity", "red", "ring"]
    np.testing.assert_array_equal(scan.fields["red"], np.arange(100) * 99)


def test_what_a_file_claims_takes_no_memory_and_what_reads_it_may_be_missing(
    tmp_path, monkeypatch
):
    path = written(tmp_path / "a.laz")
    sound = path.read_bytes()
    (start,) = struct.unpack_from("<I", sound, 96)
    (table,) = struct.unpack_from("<q", sound, start)
    for place, kind, fault in (
        (COUNT, "<Q", "40,000,000 points exceed the limit"),
        (RECORDS, "<I", "not a valid LAS"),
        (start + 8 + 37 + 4, "<I", "its layers are damaged"),  # the first one's size
        (table + 4, "<I", "its layers are damaged"),
    ):
        damaged = bytearray(sound)
        struct.pack_into(kind, damaged, place, 40_000_000)
        path.write_bytes(damaged)
        tracemalloc.start()
        with pytest.raises(InputError, match=fault):
            read_points(path)
        assert tracemalloc.get_traced_memory()[1] < 2**21
        tracemalloc.stop()
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(InputError, match=r'pip install "prism_jax\[las\]"'):
        read_points(path)
