"""Small files that claim much, and damaged files of every kind: one line, soon."""

import io
import json
import shutil
import struct
import time
import tracemalloc
import warnings
import zipfile
import zlib

import lzf
import numpy as np
import pytest
from PIL import Image

from prism_jax.io import InputError, read_points, read_scan
from prism_jax.io.arrays import MAX_MEMBERS
from prism_jax.io.ply import ply_bytes
from tests.io.test_arrays import claim

HUGE = 40_000_000
POINTS = np.random.default_rng(0).uniform(-1, 1, size=(100, 3)).astype(np.float32)
PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {}\nDATA {}\n"
PLY = "ply\nformat {} 1.0\n{}element vertex {}\n"
PLY += "property float x\nproperty float y\nproperty float z\nend_header\n"
LISTS = f"element cells {HUGE}\nproperty list uchar int i\n"
CAMERA = {"width": 10, "height": 10, "fx": 9, "fy": 9, "cx": 4.5, "cy": 4.5}


def png_header(width, height) -> bytes:
    """A PNG of one compressed byte that says how large it is."""

    def chunk(name, data):
        body = name + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    size = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(b"0"))
    return b"\x89PNG\r\n\x1a\n" + chunks + chunk(b"IEND", b"")


def archive(array: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("xyz.npy", array)
    return buffer.getvalue()


def compressed(plain: bytes, size: int) -> bytes:
    packed = lzf.compress(plain, 2 * len(plain))
    return struct.pack("<II", len(packed), size) + packed


HUGE_LISTS = PLY.format("binary_little_endian", LISTS, 1).encode()
HUGE_FILES = {
    "npy": claim((HUGE, 3)),
    "npz": archive(claim((HUGE, 3)) + bytes(10**7)),
    "ascii.pcd": PCD.format(HUGE, "ascii").encode() + b"1 2 3\n",
    "binary.pcd": PCD.format(HUGE, "binary").encode() + b"1 2 3\n",
    "binary_compressed.pcd": PCD.format(HUGE, "binary_compressed").encode()
    + compressed(bytes(10**6), 12 * HUGE),
    "vertices.ply": PLY.format("ascii", "", HUGE).encode() + b"1 2 3\n",
    "lists.ply": HUGE_LISTS + bytes(10**5),
    "png": png_header(10_000, 4_000),
}
"""Files of at most 100 kB that claim some 40 million points."""


def test_a_small_file_that_claims_much_takes_no_memory(tmp_path):
    camera = CAMERA | {"width": 10_000, "height": 4_000, "depth_scale": 1}
    (tmp_path / "scan.json").write_text(json.dumps(camera))
    for kind, data in HUGE_FILES.items():
        path = tmp_path / f"scan.{kind}"
        path.write_bytes(data)
        tracemalloc.start()
        told = r": 40,000,000 .* exceed the limit of 10,000,000"
        with pytest.raises(InputError, match=told):
            read_scan(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**21
        # More may be allowed; then it is refused because it is not there.
        with pytest.raises(InputError, match=r"not a valid"):
            read_scan(path, max_points=HUGE)


def test_max_points_is_a_limit_of_every_kind_of_cloud(tmp_path):
    for path in whole_files(tmp_path):
        if path.suffix in (".json", ".png", ".csv"):
            continue
        assert len(read_points(path, max_points=100)) == 100
        told = r": 100 \w+ exceed the limit of 99; .*max_points"
        with pytest.raises(InputError, match=told):
            read_points(path, max_points=99)


def test_archives_of_many_arrays_and_of_more_than_a_cloud(tmp_path):
    """Refused at once; what follows the cloud inside its own member is not unpacked."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        for i in range(MAX_MEMBERS + 1):
            file.writestr(f"{i}.npy", b"")
    with pytest.raises(InputError, match="more than 1,000 arrays"):
        read_points(tmp_path / "a.npz")
    cloud = POINTS.astype(np.float64).tobytes()
    path = tmp_path / "a.npz"
    path.write_bytes(archive(claim((100, 3)) + cloud + bytes(10**7)))
    tracemalloc.start()
    np.testing.assert_array_equal(read_points(path), POINTS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def whole_files(folder):
    """A small sound file of every kind."""
    np.save(folder / "a.npy", POINTS)
    np.savez(folder / "b.npz", xyz=POINTS, more=np.zeros(3))
    np.savez_compressed(folder / "c.npz", POINTS)
    np.savetxt(folder / "d.xyz", POINTS)
    np.savetxt(folder / "e.csv", POINTS, delimiter=",", header="x,y,z", comments="")
    (folder / "f.ply").write_bytes(ply_bytes(POINTS, np.arange(100) > 50))
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS)
    lists = LISTS.replace(str(HUGE), "3")
    big, text = (PLY.format(k, lists, 100) for k in ("binary_big_endian", "ascii"))
    cells = b"\x00\x01abcd\x02abcdefgh"
    (folder / "g.ply").write_bytes(
        big.encode() + cells + POINTS.astype(">f4").tobytes()
    )
    (folder / "h.ply").write_text(text + "0\n1 2\n0\n" + rows)
    (folder / "i.pcd").write_text(PCD.format(100, "ascii") + rows)
    binary, packed = (
        PCD.format(100, mode).encode() for mode in ("binary", "binary_compressed")
    )
    (folder / "j.pcd").write_bytes(binary + POINTS.tobytes())
    plain = POINTS.T.tobytes()
    (folder / "k.pcd").write_bytes(packed + compressed(plain, len(plain)))
    Image.fromarray(np.full((10, 10), 900, np.uint16)).save(folder / "l.png")
    camera = CAMERA | {"translation": [0, 0, 0.5], "rotation": np.eye(3).tolist()}
    camera |= {"depth_scale": 1e-3}
    (folder / "l.json").write_text(json.dumps(camera))
    return sorted(folder.iterdir())


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes replaced, digits added, some left out, or the file cut."""
    damaged = bytearray(data)
    # Headers are short beside the numbers, and more can go wrong there.
    end = len(data) if rng.random() < 0.3 else min(len(data), 250)
    for _ in range(rng.integers(1, 4)):
        place = int(rng.integers(end))
        new = [rng.bytes(1), b"9" * int(rng.integers(1, 30)), b""][rng.integers(3)]
        damaged[place : place + int(rng.integers(1, 20) ** rng.integers(2))] = new
    if rng.random() < 0.3:
        del damaged[int(rng.integers(len(damaged))) :]
    return bytes(damaged)


def test_whatever_is_damaged_is_one_line_within_a_second(tmp_path):
    """Some damage is not noticed, since numbers stay numbers. No memory is taken."""
    rng = np.random.default_rng(0)
    (tmp_path / "whole").mkdir()
    refused = 0
    for whole in whole_files(tmp_path / "whole"):
        shutil.copytree(tmp_path / "whole", tmp_path, dirs_exist_ok=True)
        damaged = tmp_path / whole.name
        scan = damaged.with_suffix(".png") if whole.suffix == ".json" else damaged
        read_scan(scan)
        for _ in range(40):
            damaged.write_bytes(damage(whole.read_bytes(), rng))
            started = time.process_time()
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    read_scan(scan)
                except InputError as error:
                    refused += 1
                    assert len(str(error)) < 1000
            assert time.process_time() - started < 1
    assert refused > 200
