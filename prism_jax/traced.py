"""Traces kept on disk, so that a later process compiles without tracing anew.

JAX's own cache keeps what was compiled and is asked only after the tracing, which takes
seconds for an adaptation.
"""

import hashlib
import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.export

from prism_jax.io.atomic import write_bytes

KEPT = 8
"""Traces of one folder; the oldest give way."""


def keep_traced(
    fn: Callable[..., Any], arguments: tuple[Any, ...], folder: pathlib.Path, about: Any
) -> Callable[..., Any]:
    """A function like ``fn``, for arguments like these, traced if no trace is kept.

    ``about`` is whatever else ``fn`` closes over; with the package's source, the
    versions and the arguments' shapes it names the file. What ``fn`` returns must be
    known to `jax.export`. A trace that cannot be read is made anew, and one that cannot
    be written is not kept.
    """
    structure = jax.tree.structure(arguments)

    def flat(*leaves: Any) -> Any:
        return fn(*jax.tree.unflatten(structure, leaves))

    path = folder / f"{_fingerprint(arguments, about)}.jaxexport"
    try:
        exported = jax.export.deserialize(bytearray(path.read_bytes()))
        os.utime(path)
    except Exception:  # whatever is wrong with it, another one is made
        exported = jax.export.export(jax.jit(flat))(*jax.tree.leaves(arguments))
        _keep(path, bytes(exported.serialize()))

    def call(*arguments: Any) -> Any:
        return exported.call(*jax.tree.leaves(arguments))

    return call


def _keep(path: pathlib.Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data)
        files = sorted(path.parent.glob("*.jaxexport"), key=lambda p: p.stat().st_mtime)
        for old in files[:-KEPT]:
            old.unlink(missing_ok=True)
    except (OSError, ValueError):
        return


def _fingerprint(arguments: tuple[Any, ...], about: Any) -> str:
    digest = hashlib.sha256()
    package = pathlib.Path(__file__).parent
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    shapes = jax.tree.map(jax.api_util.shaped_abstractify, arguments)
    precision = jax.config.jax_default_matmul_precision  # pyright: ignore
    for part in (jax.__version__, jax.default_backend(), precision, about, shapes):
        digest.update(repr(part).encode())
    return digest.hexdigest()[:32]
