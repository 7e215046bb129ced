"""Traces on disk: read where they fit, made anew where they do not."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.completion import compile_cache as trace_cache
from prism_jax.completion.compile_cache import compile_cached, sealed

ARGUMENTS = ({"a": jnp.arange(3.0)}, jnp.float32(2))


@pytest.fixture
def fn():
    """A function that counts how often it is traced."""

    def counted(tree, factor):
        counted.count += 1
        return {"b": factor * tree["a"]}

    counted.count = 0
    return counted


def run(fn, folder, arguments=ARGUMENTS, about="here"):
    return compile_cached(fn, arguments, folder, about)(*arguments)["b"]


def files(folder):
    return sorted(folder.glob("*.jaxexport"))


def test_the_second_time_it_is_not_traced(fn, tmp_path):
    for _ in range(2):
        np.testing.assert_array_equal(run(fn, tmp_path / "new"), [0, 2, 4])
    assert fn.count == 1
    assert len(files(tmp_path / "new")) == 1


@pytest.mark.parametrize(
    "change", ["about", "shape", "dtype", "precision", "version", "source"]
)
def test_another_function_has_another_trace(fn, tmp_path, change, monkeypatch):
    run(fn, tmp_path)
    numbers, about, precision = jnp.arange(3.0), "here", None
    if change == "about":
        about = "there"
    elif change == "shape":
        numbers = jnp.arange(4.0)
    elif change == "dtype":
        numbers = jnp.arange(3)
    elif change == "precision":
        precision = "bfloat16"
    elif change == "version":
        monkeypatch.setattr(jax, "__version__", "0")
    else:
        # A room beside the cache's own has another file.
        room = tmp_path / "source" / "completion"
        (tmp_path / "source" / "models").mkdir(parents=True)
        (tmp_path / "source" / "models" / "layers.py").write_text("")
        monkeypatch.setattr(trace_cache, "__file__", str(room / "compile_cache.py"))
    with jax.default_matmul_precision(precision):
        run(fn, tmp_path, ({"a": numbers}, jnp.float32(2)), about)
    assert fn.count == len(files(tmp_path)) == 2


def flipped(content):
    """The first place of many where a changed bit is not noticed by JAX."""
    for place in range(40, len(content), 7):
        changed = bytearray(content)
        changed[place] ^= 1
        with contextlib.suppress(Exception):
            jax.export.deserialize(changed[32:])
            return bytes(changed)
    raise AssertionError("every bit is noticed")


FAULTS = {
    "a bit flipped that JAX does not notice": lambda name, kept: flipped(kept),
    "nonsense with its digest": lambda name, kept: sealed(name, b"nonsense"),
    "the trace of another name": lambda name, kept: sealed("other", kept[32:]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_trace_that_fails_is_removed_and_made_anew(fn, tmp_path, fault):
    run(fn, tmp_path)
    (file,) = files(tmp_path)
    whole = file.read_bytes()
    broken = FAULTS[fault](file.stem, whole)
    assert broken != whole
    file.write_bytes(broken)
    for _ in range(2):
        np.testing.assert_array_equal(run(fn, tmp_path), [0, 2, 4])
        assert fn.count == 2
    assert files(tmp_path) == [file]
    assert file.read_bytes() != broken


def test_a_fault_of_the_function_itself_is_told_and_no_trace_need_be_kept(fn, tmp_path):
    def fail(tree, factor):
        raise ZeroDivisionError("its own")

    with pytest.raises(ZeroDivisionError, match="its own"):
        run(fail, tmp_path)
    assert files(tmp_path) == []
    (tmp_path / "file").touch()
    np.testing.assert_array_equal(run(fn, tmp_path / "file" / "folder"), [0, 2, 4])


def test_the_oldest_give_way(fn, tmp_path, monkeypatch):
    monkeypatch.setattr(trace_cache, "MAX_TRACES", 2)
    for i in range(4):
        run(fn, tmp_path, about=i)
    assert len(files(tmp_path)) == 2
    run(fn, tmp_path, about=3)
    assert fn.count == 4
