"""States on disk: whole or not at all."""

import contextlib
import gc
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.io.errors import InputError
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.phase import TrainState
from tests.trees import bitwise


def state(step):
    rng = np.random.default_rng(step)
    weights = rng.normal(size=(3, 2)).astype(np.float32)
    params = {"a": weights, "b": {"c": np.float32(2)}}
    return jax.device_put(
        TrainState(jnp.int32(step), {"params": params}, (jnp.ones(2) * step, ()))
    )


LIKE = state(0)


def save(checkpoints, step, score):
    checkpoints.save(step, state(step), score)


@pytest.fixture
def checkpoints(tmp_path):
    with contextlib.closing(Checkpoints(tmp_path)) as opened:
        yield opened


def reopened(folder):
    with contextlib.closing(Checkpoints(folder)) as again:
        return again.restore(LIKE), again.restore(LIKE, best=True), again.best_score()


def test_latest_and_best(checkpoints, tmp_path):
    """One of each is kept; an equal score does not replace the best, and one that is
    not a number never is, not even the first."""
    assert checkpoints.restore(LIKE) is None
    assert checkpoints.restore(LIKE, best=True) is None
    save(checkpoints, 1, float("nan"))
    assert checkpoints.best_score() is None
    scores = {2: 0.5, 4: 0.3, 6: 0.4, 7: float("nan"), 8: 0.3, 9: None}
    for step, score in scores.items():
        save(checkpoints, step, score)
    checkpoints.close()
    latest, best, score = reopened(tmp_path)
    assert bitwise(latest, state(9))
    assert bitwise(best, state(4))
    assert score == pytest.approx(0.3)
    for kind, kept in (("latest", "9"), ("best", "4")):
        found = (tmp_path / "checkpoints" / kind).iterdir()
        assert [path.name for path in found] == [kept]


def test_the_best_is_written_before_the_latest(checkpoints, monkeypatch):
    """A run that ends in between goes on from the latest before, and finds it again."""
    save(checkpoints, 2, 0.5)

    def ended(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints._latest, "save", ended)
    with pytest.raises(KeyboardInterrupt):
        save(checkpoints, 4, 0.3)
    assert bitwise(checkpoints.restore(LIKE), state(2))
    assert bitwise(checkpoints.restore(LIKE, best=True), state(4))


def test_a_write_that_was_killed_leaves_the_one_before(checkpoints, tmp_path):
    """And training goes on over it."""
    save(checkpoints, 4, 0.5)
    checkpoints.close()
    for kind in ("latest", "best"):
        folder = tmp_path / "checkpoints" / kind
        target = folder / "8.orbax-checkpoint-tmp"
        shutil.copytree(folder / "4", target)
        files = sorted(path for path in target.rglob("*") if path.is_file())
        for i, path in enumerate(files):
            half = path.read_bytes()[: path.stat().st_size // 2]
            path.write_bytes(half) if i % 2 else path.unlink()
    latest, best, score = reopened(tmp_path)
    assert bitwise(latest, state(4)) and bitwise(best, state(4))
    assert score == pytest.approx(0.5)
    with contextlib.closing(Checkpoints(tmp_path)) as again:
        save(again, 8, 0.4)
    assert all(bitwise(each, state(8)) for each in reopened(tmp_path)[:2])


# Orbax leaves its other reads unfinished when one fails.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_damaged_one_is_one_line(checkpoints, tmp_path):
    """Whatever file it is, cut off or with other bits, if it is needed at all."""
    save(checkpoints, 4, 0.5)
    checkpoints.close()
    folder = tmp_path / "checkpoints" / "best"
    refused = 0
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        flipped = bytes(c ^ (0x55 * (i % 9 == 0)) for i, c in enumerate(content))
        for damaged in (content[: len(content) // 2], flipped):
            path.write_bytes(damaged)
            try:
                found = reopened(tmp_path)
                assert all(bitwise(each, state(4)) for each in found[:2]), path
            except InputError as error:
                assert str(error).startswith(f"{folder}: not a sound checkpoint")
                assert "\n" not in str(error)
                refused += 1
        path.write_bytes(content)
        gc.collect()
    assert refused >= 8
