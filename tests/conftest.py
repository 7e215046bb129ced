"""What every test shares: shape checking, a compilation cache, optional data."""

import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path

_CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE / "prism_jax" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

import jax
import numpy as np
import pytest
from jaxtyping import install_import_hook

install_import_hook("prism_jax", "beartype.beartype")

_SHARED = Path(__file__).resolve().parents[2] / "shared"


def _optional(folder: str, name: str) -> Path:
    path = _SHARED / folder / name
    if not path.exists():
        pytest.skip(f"optional test data ../shared/{folder}/{name} is not present")
    return path


@pytest.fixture(scope="session")
def parity() -> Callable[[str], Mapping[str, np.ndarray]]:
    """Loads ``../shared/parity/NAME`` (arrays of the reference model), or skips."""

    @functools.cache
    def load(name: str) -> Mapping[str, np.ndarray]:
        return np.load(_optional("parity", name), allow_pickle=False)

    return load


@pytest.fixture(scope="session")
def real() -> Callable[[str], Path]:
    """The path of ``../shared/real/NAME`` (a real scan), or skips."""
    return lambda name: _optional("real", name)


@pytest.fixture
def x64():
    """Double precision, for finite differences."""
    with jax.enable_x64(True):
        yield
