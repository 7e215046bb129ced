"""What every test shares: shape checking, a compilation cache, optional data."""

import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path

_CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE / "prism_jax" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

# JAX reads its environment when it is imported.
import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

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


@pytest.fixture(scope="session")
def tiny():
    """Configuration of the smallest preset."""
    from prism_jax.presets import PRESETS

    return PRESETS["tiny"].config


@pytest.fixture(scope="session")
def tiny_variables(tiny):
    """Fresh variables of `tiny`."""
    from prism_jax.models.initial import init_variables

    return init_variables(jax.random.key(0), tiny.model)


@pytest.fixture(scope="session")
def tiny_adapt(tiny):
    """Test-time adaptation of `tiny`, compiled once for all tests."""
    from prism_jax.adaptation.test_time import make_adapt

    return jax.jit(make_adapt(tiny))


@pytest.fixture(scope="session")
def tiny_frames(tiny):
    """Three partial clouds, half shells of boxes, and the cameras that saw them."""
    from prism_jax.geometry.camera import Camera

    rng = np.random.default_rng(0)
    eyes = rng.normal(size=(3, 1, 3))
    eyes *= 3.0 / np.linalg.norm(eyes, axis=-1, keepdims=True)
    shell = rng.uniform(-1, 1, (3, tiny.model.backbone.num_points, 3))
    shell /= np.abs(shell).max(-1, keepdims=True)
    shell *= np.sign((shell * eyes).sum(-1, keepdims=True))
    partials = jax.numpy.asarray(shell * [0.7, 0.5, 0.4], np.float32)
    cameras = jax.vmap(Camera.framing)(partials, eyes[:, 0].astype(np.float32))
    return partials, cameras


@pytest.fixture(scope="session")
def minimal():
    """A preset of one resolution and one up-sampling block: quick to compile."""
    from experiments.settings import resolve

    changes = [
        "num_neighbors=(4,)",
        "encoder_rates=(1,)",
        "level_rates=((1,),)",
        "up_factors=(2,)",
    ]
    return resolve("tiny", [f"model.backbone.{change}" for change in changes])


@pytest.fixture(scope="session")
def minimal_variables(minimal):
    """Variables of `minimal`: any numbers will do, and cost no compilation."""
    from prism_jax.models.initial import init_variables

    rng = np.random.default_rng(0)

    def fill(path, leaf):
        name = path[-1].key
        if name in ("var", "scale", "mean", "logits", "scales"):
            return jax.numpy.full(
                leaf.shape, float(name in ("var", "scale")), np.float32
            )
        width = leaf.shape[0] if leaf.ndim > 1 else 100
        values = rng.normal(size=leaf.shape) / width**0.5
        return jax.numpy.asarray(values, np.float32)

    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), minimal.model))
    return jax.tree_util.tree_map_with_path(fill, shapes)


@pytest.fixture(scope="session")
def quick_jit():
    """`jax.jit` for what runs but a few times: half as long to compile on a CPU."""
    options = {"xla_backend_optimization_level": 0}
    on_cpu = jax.default_backend() == "cpu"
    return functools.partial(jax.jit, compiler_options=options if on_cpu else None)
