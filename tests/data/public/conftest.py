"""Clouds, and the means to write them as the sets publish them."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

SYNSETS = ("02691156", "02958343")
"""Of airplanes and cars."""


@pytest.fixture(scope="session")
def cloud() -> Callable[[int, int], np.ndarray]:
    """Random points, off centre: (seed, count) -> float32."""

    def make(seed: int, count: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return (rng.normal(size=(count, 3)) + [3.0, 0.0, -1.0]).astype(np.float32)

    return make


@pytest.fixture(scope="session")
def write() -> Callable[..., Path]:
    """Writes an array as the suffix says, or text, or JSON; makes the folders."""

    def to_file(path: Path, content) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".json":
            path.write_text(json.dumps(content))
        elif isinstance(content, str):
            path.write_text(content)
        else:
            path.write_bytes(_ENCODERS[path.suffix](content))
        return path

    return to_file


def _npy(points: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, points, allow_pickle=False)
    return buffer.getvalue()


def _pcd(points: np.ndarray) -> bytes:
    size = f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n" + size
    return header.encode() + np.asarray(points, "<f4").tobytes()


def _txt(rows: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savetxt(buffer, rows)
    return buffer.getvalue()


_ENCODERS = {".npy": _npy, ".pcd": _pcd, ".txt": _txt}
