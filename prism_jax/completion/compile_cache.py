"""Compiled functions kept on disk, so that a later process neither traces nor compiles.

Loading one is running it, and unpickles what belongs to it: only what this program
wrote is loaded, from a folder and a file of the user's own that nobody else may write.
"""

import contextlib
import hashlib
import importlib.metadata
import os
import pathlib
import pickle
import platform
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
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
"""XLA's options that compile fast what then runs slowly: for a few scans.
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

    ``quick`` compiles with `QUICK`. ``about`` is whatever else ``fn`` closes over; a
    file is named by it and all else that decides (`_fingerprint`). A kept program that
    does not load is removed, and ``fn`` compiled anew. One that cannot be written is
    not kept.
    """
    if folder is not None and os.path.exists(folder) and _others_write(folder.stat()):
        fault = "others may write there, so no compiled program is kept"
        warnings.warn(f"{folder}: {fault}; remove it, or chmod go-w it", stacklevel=2)
        folder = None
    if folder is None:
        return _compile(fn, arguments, quick)
    path = folder / f"{_fingerprint(arguments, (about, quick))}{SUFFIX}"
    try:
        return _load(path)
    except FileNotFoundError:
        pass
    except Exception:  # whatever is wrong with it, another one is made
        with contextlib.suppress(OSError):
            path.unlink()
    # XLA 0.10 writes what it read from JAX's own cache without its machine code.
    enabled = jax.config.jax_enable_compilation_cache  # pyright: ignore
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()  # JAX looks at the setting once
    try:
        compiled = _compile(fn, arguments, quick)
    finally:
        jax.config.update("jax_enable_compilation_cache", enabled)
        reset_cache()
    _keep(path, compiled)
    return compiled


def _compile(
    fn: Callable[..., Any], arguments: tuple[Any, ...], quick: bool
) -> jax.stages.Compiled:
    options: dict[str, Any] = {}
    for name, value in QUICK.items() if quick else ():
        # Any that this version of XLA does not know would be an error.
        with contextlib.suppress(Exception):
            jax.jit(jnp.negative).lower(0.0).compile(compiler_options={name: value})
            options[name] = value
    return jax.jit(fn).lower(*arguments).compile(compiler_options=options)


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
    device: Any = jnp.zeros(()).device
    compiled = serialize_executable.deserialize_and_load(
        *pickle.loads(program), backend=device.client, execution_devices=[device]
    )
    os.utime(path)
    return compiled


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


def _others_write(status: os.stat_result) -> bool:
    """Whether a file is another user's, or may be written by the group or all."""
    if os.name != "posix":
        return False  # the modes say nothing there, and the profile is the user's own
    return status.st_uid != os.geteuid() or bool(status.st_mode & 0o022)


def _processor() -> list[str]:
    """What machine code depends on beside the backend: a home may be shared."""
    parts = ("model name", "flags", "CPU part", "Features")
    try:
        told = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return [platform.processor()]
    return sorted({line for line in told if line.startswith(parts)})


def _fingerprint(arguments: tuple[Any, ...], about: Any) -> str:
    digest = hashlib.sha256()
    package = pathlib.Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    shapes = jax.tree.map(jax.api_util.shaped_abstractify, arguments)
    device: Any = jnp.zeros(()).device
    precision = jax.config.jax_default_matmul_precision  # pyright: ignore
    for part in (
        (jax.__version__, importlib.metadata.version("jaxlib"), platform.uname()[::4]),
        (_processor(), device, device.device_kind, device.client.platform_version),
        (precision, os.environ.get("XLA_FLAGS"), QUICK, about, shapes),
    ):
        digest.update(repr(part).encode())
    return digest.hexdigest()[:32]
