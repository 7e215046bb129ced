"""Clouds, and the means to write them as the sets publish them."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


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
            path.write_bytes(_npy(content))
        return path

    return to_file


def _npy(points: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, points, allow_pickle=False)
    return buffer.getvalue()
