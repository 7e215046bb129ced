"""What every test shares: shape checking, a compilation cache, optional data."""

import dataclasses
import functools
import gc
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

_CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE / "prism_jax" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

# Compile in a third of the time, and round differently: `XLA_FLAGS= pytest` tests what
# users run. The latter two may go one day.
_QUICK = "--xla_backend_optimization_level=0"
_QUICKER = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)


def _quick_flags() -> str:
    """The flags that this version of XLA knows: any other would end the process."""
    flags = f"{_QUICK} {_QUICKER}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    tried = subprocess.run(command, env=environment, capture_output=True)
    return flags if tried.returncode == 0 else _QUICK


if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = _quick_flags()

# Tracing makes many objects and few cycles: looking for those less often saves a
# twentieth of the time.
gc.set_threshold(100_000, 20, 20)

# JAX reads its environment when it is imported.
import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

install_import_hook("prism_jax", "beartype.beartype")


TOGETHER = {
    "completion/test_completer.py": "completer",
    "completion/test_scene.py": "completer",
    "streaming/test_completer.py": "completer",
    "cli/test_stream.py": "completer",
    "completion/test_weights.py": "weights",
    "reporting/test_model_card.py": "weights",
    "experiments/baselines/": "baselines",
}
"""Files, and folders of files, that share what is compiled."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """One process runs all tests of a file, and of files that belong together."""
    from xdist.scheduler import LoadFileScheduling

    class Together(LoadFileScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.split("::")[0].removeprefix("tests/")
            own = (group for start, group in TOGETHER.items() if file.startswith(start))
            return next(own, file)

    return Together(config, log)


_GOLDEN = Path(__file__).resolve().parent / "golden"
_SHARED = Path(__file__).resolve().parents[2] / "shared"


def _optional(folder: str, name: str) -> Path:
    path = _SHARED / folder / name
    if not path.exists():
        pytest.skip(f"optional test data ../shared/{folder}/{name} is not present")
    return path


@pytest.fixture(scope="session")
def golden() -> Callable[[str], Mapping[str, np.ndarray]]:
    """Loads ``tests/golden/NAME``: arrays that the official CRA-PCN computed."""
    return functools.cache(lambda name: np.load(_GOLDEN / name, allow_pickle=False))


@pytest.fixture(
    scope="session", params=["small", pytest.param("full", marks=pytest.mark.slow)]
)
def reference(request, golden) -> Callable[[str], Mapping[str, np.ndarray]]:
    """As `golden`. A test that asks for this runs again, marked slow, with the network
    in its published size (``../shared/parity/NAME``), and skips that without it."""
    if request.param == "small":
        return golden
    return functools.cache(
        lambda name: np.load(_optional("parity", name), allow_pickle=False)
    )


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
    from experiments.presets import PRESETS

    return PRESETS["tiny"].config


def _variables(model, fill):
    """Variables of arrays ``fill(path, shape)``: none of the compilation that fresh
    ones cost."""
    from prism_jax.models.initial import init_variables

    def leaf(path, leaf):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        return jax.numpy.asarray(fill(name, leaf.shape), np.float32)

    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), model))
    return jax.tree_util.tree_map_with_path(leaf, shapes)


def _as_fresh(model):
    """Variables as large as fresh ones."""
    rng = np.random.default_rng(0)
    factors = {
        "offset/dense_1/kernel": 0.03,
        "denoiser/mlp/dense_2/kernel": 0.03,
        "refiner/g/dense_1/kernel": 0.0,
    }

    def fill(name, shape):
        if len(shape) < 2:
            return np.full(shape, float(name.endswith(("/var", "/scale"))))
        factor = next((f for end, f in factors.items() if name.endswith(end)), 1.0)
        return factor * rng.normal(size=shape) / np.prod(shape[:-1]) ** 0.5

    return _variables(model, fill)


@pytest.fixture(scope="session")
def as_fresh():
    """Variables, as large as fresh ones, of a model's configuration."""
    return _as_fresh


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
def minimal_fresh(minimal):
    """Variables of `minimal`, as large as fresh ones."""
    return _as_fresh(minimal.model)


@pytest.fixture(scope="session")
def minimal_variables(minimal):
    """Variables of `minimal`, of any numbers."""
    rng = np.random.default_rng(0)

    def fill(name, shape):
        kind = name.rpartition("/")[2]
        if kind in ("var", "scale", "mean", "logits", "scales"):
            return np.full(shape, float(kind in ("var", "scale")))
        width = shape[0] if len(shape) > 1 else 100
        return rng.normal(size=shape) / width**0.5

    return _variables(minimal.model, fill)


@pytest.fixture(scope="session")
def completer(minimal, minimal_variables):
    """A completer of `minimal` that adapts in one step. What it has compiled is there
    for all who are in the xdist group "completer"."""
    from prism_jax.completion.completer import Completer

    return Completer(minimal.config.with_adapt(num_steps=1), minimal_variables)


@pytest.fixture(scope="session")
def reading(minimal):
    """The configuration of `minimal` with a network that reads what is known."""
    reads = ("reads_visibility", "seeds_read_visibility")
    model = minimal.config.model
    backbone = dataclasses.replace(model.backbone, **dict.fromkeys(reads, True))
    model = dataclasses.replace(model, backbone=backbone)
    return dataclasses.replace(minimal.config, model=model)


@pytest.fixture(scope="session")
def reading_fresh(reading):
    """Variables of `reading`, as large as fresh ones."""
    return _as_fresh(reading.model)


@pytest.fixture(scope="session")
def quick_jit():
    """`jax.jit` for what runs but a few times: half as long to compile on a CPU."""
    options = {"xla_backend_optimization_level": 0}
    on_cpu = jax.default_backend() == "cpu"
    return functools.partial(jax.jit, compiler_options=options if on_cpu else None)
