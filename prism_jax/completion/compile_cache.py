"""Traces of functions kept on disk, so that a later process need not trace again.

JAX's own cache keeps what was compiled, but asks for it only after tracing, which takes
seconds for an adaptation.
"""

import contextlib
import hashlib
import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.export

from prism_jax.io.atomic import write_bytes

MAX_TRACES = 8  # traces in one folder; the oldest are removed

_DIGEST_BYTES = hashlib.sha256().digest_size


def compile_cached(
    fn: Callable[..., Any], arguments: tuple[Any, ...], folder: pathlib.Path, about: Any
) -> Callable[..., Any]:
    """Compiles ``fn`` for arguments like these, from the trace in ``folder`` if any.

    ``about`` is whatever else ``fn`` closes over. The file's name is made of it, of the
    package's source, JAX's version and the arguments' shapes. What ``fn`` returns must
    be known to `jax.export`. A kept trace that is damaged, is of another function or
    fails in any other way is removed, and ``fn`` is traced again. A trace that cannot
    be written is not kept.
    """
    structure = jax.tree.structure(arguments)

    def flat(*leaves: Any) -> Any:
        return fn(*jax.tree.unflatten(structure, leaves))

    name = _fingerprint(arguments, about)
    path = folder / f"{name}.jaxexport"
    try:
        content = path.read_bytes()
        trace = content[_DIGEST_BYTES:]
        if sealed(name, trace) != content:
            raise ValueError("damaged, or kept under another name")
        exported = jax.export.deserialize(bytearray(trace))
        compiled = _compile(exported, arguments)
        os.utime(path)
        return compiled
    except FileNotFoundError:
        pass
    except Exception:  # whatever is wrong with it, another one is made
        with contextlib.suppress(OSError):
            path.unlink()
    exported = jax.export.export(jax.jit(flat))(*jax.tree.leaves(arguments))
    _keep(path, sealed(name, bytes(exported.serialize())))
    return _compile(exported, arguments)


def sealed(name: str, trace: bytes) -> bytes:
    """A file's content: the digest of its name and its trace, and the trace."""
    return hashlib.sha256(name.encode() + trace).digest() + trace


def _compile(
    exported: jax.export.Exported, arguments: tuple[Any, ...]
) -> Callable[..., Any]:
    def call(*arguments: Any) -> Any:
        return exported.call(*jax.tree.leaves(arguments))

    return jax.jit(call).lower(*arguments).compile()


def _keep(path: pathlib.Path, content: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content)
        files = sorted(path.parent.glob("*.jaxexport"), key=lambda p: p.stat().st_mtime)
        for old in files[:-MAX_TRACES]:
            old.unlink(missing_ok=True)
    except (OSError, ValueError):
        return


def _fingerprint(arguments: tuple[Any, ...], about: Any) -> str:
    digest = hashlib.sha256()
    package = pathlib.Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    shapes = jax.tree.map(jax.api_util.shaped_abstractify, arguments)
    precision = jax.config.jax_default_matmul_precision  # pyright: ignore
    for part in (jax.__version__, jax.default_backend(), precision, about, shapes):
        digest.update(repr(part).encode())
    return digest.hexdigest()[:32]
