"""Compiled programs on disk: read where they fit, made anew where they do not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.completion import compile_cache
from prism_jax.completion.compile_cache import QUICK, compile_cached, sealed

ARGUMENTS = ({"a": jnp.arange(3.0)}, jnp.float32(2))


@pytest.fixture
def fn():
    """A function that counts how often it is traced."""

    def counted(tree, factor):
        counted.count += 1
        return {"b": factor * tree["a"]}

    counted.count = 0
    return counted


def run(fn, folder, arguments=ARGUMENTS, about="here", quick=False):
    def anew(*given):  # JAX keeps the traces of a function that it knows
        return fn(*given)

    return compile_cached(anew, arguments, folder, about, quick)(*arguments)["b"]


def files(folder):
    return sorted(folder.glob("*.jaxcompiled"))


def test_the_second_time_it_is_not_traced(fn, tmp_path):
    for _ in range(2):
        np.testing.assert_array_equal(run(fn, tmp_path / "new"), [0, 2, 4])
    assert fn.count == 1
    assert len(files(tmp_path / "new")) == 1


@pytest.mark.parametrize(
    "change",
    ["about", "shape", "dtype", "precision", "version", "source", "processor", "quick"],
)
def test_another_function_is_another_program(fn, tmp_path, change, monkeypatch):
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
    elif change == "processor":
        monkeypatch.setattr(compile_cache, "_processor", lambda: "no avx2")
    elif change == "source":
        # A room beside the cache's own has another file.
        room = tmp_path / "source" / "completion"
        (tmp_path / "source" / "models").mkdir(parents=True)
        (tmp_path / "source" / "models" / "layers.py").write_text("")
        monkeypatch.setattr(compile_cache, "__file__", str(room / "compile_cache.py"))
    with jax.default_matmul_precision(precision):
        arguments = {"a": numbers}, jnp.float32(2)
        run(fn, tmp_path, arguments, about, quick=change == "quick")
    assert fn.count == len(files(tmp_path)) == 2


FAULTS = {
    "truncated": lambda name, kept: kept[:-1],
    "nonsense with its digest": lambda name, kept: sealed(name, b"nonsense"),
    "the program of another name": lambda name, kept: sealed("other", kept[32:]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_program_that_fails_is_removed_and_made_anew(fn, tmp_path, fault):
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


def test_what_others_may_write_is_not_loaded(fn, tmp_path, monkeypatch):
    """Neither from their folder nor from their file: loading it is running it."""
    run(fn, tmp_path)
    (file,) = files(tmp_path)
    file.chmod(0o620)
    run(fn, tmp_path)
    assert fn.count == 2 and file.stat().st_mode & 0o777 == 0o600
    tmp_path.chmod(0o770)
    with pytest.warns(UserWarning, match="others may write there"):
        run(fn, tmp_path)
    assert fn.count == 3
    tmp_path.chmod(0o700)
    monkeypatch.setattr("os.geteuid", lambda: file.stat().st_uid + 1)
    with pytest.warns(UserWarning, match="others may write there"):
        run(fn, tmp_path)
    assert fn.count == 4


def test_options_that_xla_does_not_know_are_left_out(fn, tmp_path, monkeypatch):
    monkeypatch.setattr(compile_cache, "QUICK", QUICK | {"xla_unheard_of": 1})
    np.testing.assert_array_equal(run(fn, tmp_path, quick=True), [0, 2, 4])


def test_a_fault_of_the_function_itself_is_told_and_no_program_need_be_kept(
    fn, tmp_path
):
    def fail(tree, factor):
        raise ZeroDivisionError("its own")

    with pytest.raises(ZeroDivisionError, match="its own"):
        run(fail, tmp_path)
    assert files(tmp_path) == []
    (tmp_path / "file").touch()
    np.testing.assert_array_equal(run(fn, tmp_path / "file" / "folder"), [0, 2, 4])


def test_the_oldest_give_way(fn, tmp_path, monkeypatch):
    """JAX's own cache is off meanwhile: what is read from there cannot be kept."""
    monkeypatch.setattr(compile_cache, "MAX_KEPT", 2)
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    for i in range(4):
        run(fn, tmp_path, about=i)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    assert len(files(tmp_path)) == 2
    run(fn, tmp_path, about=3)
    assert fn.count == 4
