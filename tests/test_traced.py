"""Traces on disk: read where they fit, made anew where they do not."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax import traced
from prism_jax.traced import keep_traced

ARGUMENTS = ({"a": jnp.arange(3.0)}, jnp.float32(2))


class Counted:
    """A function that counts how often it is traced."""

    def __init__(self):
        self.count = 0

    def __call__(self, tree, factor):
        self.count += 1
        return {"b": factor * tree["a"]}


@pytest.fixture
def fn():
    return Counted()


def run(fn, folder, arguments=ARGUMENTS, about="here"):
    return jax.jit(keep_traced(fn, arguments, folder, about))(*arguments)["b"]


def files(folder):
    return sorted(folder.glob("*.jaxexport"))


def test_the_second_time_it_is_not_traced(fn, tmp_path):
    for _ in range(2):
        np.testing.assert_array_equal(run(fn, tmp_path / "new"), [0, 2, 4])
    assert fn.count == 1
    assert len(files(tmp_path / "new")) == 1


@pytest.mark.parametrize(
    "change", ["about", "shape", "dtype", "version", "precision", "source"]
)
def test_another_function_has_another_trace(fn, tmp_path, change, monkeypatch):
    run(fn, tmp_path)
    arguments, about, stack = ARGUMENTS, "here", contextlib.ExitStack()
    if change == "about":
        about = "there"
    elif change == "shape":
        arguments = ({"a": jnp.arange(4.0)}, jnp.float32(2))
    elif change == "dtype":
        arguments = ({"a": jnp.arange(3)}, jnp.float32(2))
    elif change == "version":
        monkeypatch.setattr(jax, "__version__", "0")
    elif change == "precision":
        stack.enter_context(jax.default_matmul_precision("bfloat16"))
    else:
        monkeypatch.setattr(traced, "__file__", str(tmp_path / "traced.py"))
    with stack:
        run(fn, tmp_path, arguments, about)
    assert fn.count == 2
    assert len(files(tmp_path)) == 2


@pytest.mark.parametrize("content", [b"", b"nonsense", None])
def test_what_cannot_be_read_is_made_anew(fn, tmp_path, content):
    run(fn, tmp_path)
    (file,) = files(tmp_path)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    np.testing.assert_array_equal(run(fn, tmp_path), [0, 2, 4])
    assert fn.count == 2
    np.testing.assert_array_equal(run(fn, tmp_path), [0, 2, 4])
    assert fn.count == 2


def test_what_cannot_be_written_is_not_kept(fn, tmp_path):
    (tmp_path / "file").touch()
    np.testing.assert_array_equal(run(fn, tmp_path / "file" / "folder"), [0, 2, 4])


def test_the_oldest_give_way(fn, tmp_path):
    for i in range(traced.KEPT + 3):
        run(fn, tmp_path, about=i)
    assert len(files(tmp_path)) == traced.KEPT
