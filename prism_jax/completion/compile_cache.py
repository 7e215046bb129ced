"""Compiled functions kept on disk, so that a later process neither traces nor compiles.

JAX's own cache is asked only after tracing and lowering, which take seconds.

A kept program is machine code, and JAX unpickles what belongs to it, so loading one is
running it. Only files that the program wrote for this user are loaded: file and folder
are the user's own, and nobody else may write to them.
"""

import contextlib
import hashlib
import os
import pathlib
import pickle
import platform
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from prism_jax.io.atomic import write_bytes

MAX_KEPT = 8  # programs in one folder; the oldest are removed
SUFFIX = ".jaxcompiled"

QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_cpu_parallel_codegen_split_count": 1,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_experimental_ynn_fusion_type": "",
}
"""XLA's options that compile in a third of the time for a run three times as slow.
Programs without YNN's fusions also load in half the time."""

_DIGEST_BYTES = hashlib.sha256().digest_size


def compile_cached(
    fn: Callable[..., Any],
    arguments: tuple[Any, ...],
    folder: pathlib.Path | None = None,
    about: Any = None,
    quick: bool = False,
) -> Callable[..., Any]:
    """Compiles ``fn`` for arguments like these, or loads it from ``folder`` if kept.

    ``quick`` compiles with `QUICK`. ``about`` is whatever else ``fn`` closes over. The
    file's name is made of it, of the package's source, the versions of JAX, the device,
    the processor and the arguments' shapes. A kept program that is damaged, is of
    another function or does not load is removed, and ``fn`` is compiled anew. One that
    cannot be written is not kept, and a folder that others may write to is not used.
    """
    path = None
    if folder is not None and _is_private(folder):
        path = folder / f"{_fingerprint(arguments, (about, quick))}{SUFFIX}"
        try:
            return _load(path)
        except FileNotFoundError:
            pass
        except Exception:  # whatever is wrong with it, another one is made
            with contextlib.suppress(OSError):
                path.unlink()
    options = _known(QUICK) if quick else {}
    lowered = jax.jit(fn).lower(*arguments)
    if path is None:
        return lowered.compile(compiler_options=options)
    with _without_jax_cache():
        compiled = lowered.compile(compiler_options=options)
    _keep(path, compiled)
    return compiled


def sealed(name: str, program: bytes) -> bytes:
    """A file's content: the digest of its name and its program, and the program."""
    return hashlib.sha256(name.encode() + program).digest() + program


def _load(path: pathlib.Path) -> Callable[..., Any]:
    with path.open("rb") as file:
        if _others_write(os.fstat(file.fileno())):
            raise PermissionError("not the user's own")
        content = file.read()
    program = content[_DIGEST_BYTES:]
    if sealed(path.stem, program) != content:
        raise ValueError("damaged, or kept under another name")
    device = _device()
    compiled = serialize_executable.deserialize_and_load(
        *pickle.loads(program), backend=device.client, execution_devices=[device]
    )
    os.utime(path)
    return compiled


@contextlib.contextmanager
def _without_jax_cache() -> Iterator[None]:
    """Without JAX's own cache: XLA 0.10 writes a program that was read from there
    without its machine code, and it fails when it is called."""
    name = "jax_enable_compilation_cache"
    enabled = getattr(jax.config, name)
    jax.config.update(name, False)
    reset_cache()  # JAX looks at the setting once
    try:
        yield
    finally:
        jax.config.update(name, enabled)
        reset_cache()


def _keep(path: pathlib.Path, compiled: jax.stages.Compiled) -> None:
    # A program that has run can no longer be written, and some never can.
    with contextlib.suppress(Exception):
        program = pickle.dumps(serialize_executable.serialize(compiled))
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_bytes(path, sealed(path.stem, program))
        path.chmod(0o600)
        kept = sorted(path.parent.glob(f"*{SUFFIX}"), key=lambda p: p.stat().st_mtime)
        for old in kept[:-MAX_KEPT]:
            old.unlink(missing_ok=True)


def _is_private(folder: pathlib.Path) -> bool:
    """Whether nobody else may write to the folder, or it is still to be made."""
    try:
        if not _others_write(folder.stat()):
            return True
    except OSError:
        return True
    fault = f"{folder}: others may write to it, so that no compiled program is kept"
    warnings.warn(f"{fault} there; chmod go-w it, or remove it", stacklevel=2)
    return False


def _others_write(status: os.stat_result) -> bool:
    """Whether a file is another user's, or may be written by the group or all."""
    if os.name != "posix":
        return False  # the modes say nothing there, and the profile is the user's own
    return status.st_uid != os.geteuid() or bool(status.st_mode & 0o022)


def _known(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those that this version of XLA knows: any other would be an error."""
    trial, known = jax.jit(jnp.negative).lower(0.0), {}
    for name, value in options.items():
        with contextlib.suppress(Exception):
            trial.compile(compiler_options={name: value})
            known[name] = value
    return known


def _device() -> Any:
    """The one that functions are compiled for."""
    (device,) = jnp.zeros(()).devices()
    return device


def _processor() -> str:
    """What machine code depends on beside the backend: a home may be shared."""
    try:
        first = pathlib.Path("/proc/cpuinfo").read_text().split("\n\n")[0]
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    parts = ("model name", "flags", "CPU part", "Features")
    return "\n".join(line for line in first.splitlines() if line.startswith(parts))


def _fingerprint(arguments: tuple[Any, ...], about: Any) -> str:
    digest = hashlib.sha256()
    package = pathlib.Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    shapes = jax.tree.map(jax.api_util.shaped_abstractify, arguments)
    device, config = _device(), jax.config
    settings = config.jax_default_matmul_precision, config.jax_enable_x64  # pyright: ignore
    for part in (
        (jax.__version__, jaxlib.version.__version__, platform.system(), _processor()),
        (device, device.device_kind, device.client.platform_version),
        (settings, os.environ.get("XLA_FLAGS"), QUICK),
        (about, shapes),
    ):
        digest.update(repr(part).encode())
    return digest.hexdigest()[:32]
