"""States on disk: whole or not at all."""

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
    params = {
        "a": rng.normal(size=(3, 2)).astype(np.float32),
        "b": {"c": np.float32(2)},
    }
    return jax.device_put(
        TrainState(jnp.int32(step), {"params": params}, (jnp.ones(2) * step, ()))
    )


LIKE = state(0)


def save(checkpoints, step, score=None):
    checkpoints.save(step, state(step), score)


@pytest.fixture
def checkpoints(tmp_path):
    opened = Checkpoints(tmp_path)
    yield opened
    opened.close()


def reopened(folder):
    again = Checkpoints(folder)
    found = again.restore_latest(LIKE), again.restore_best(LIKE), again.best_score()
    again.close()
    return found


def test_an_empty_folder_has_none(checkpoints):
    assert checkpoints.restore_latest(LIKE) is None
    assert checkpoints.restore_best(LIKE) is None
    assert checkpoints.best_score() is None


def test_latest_and_best(checkpoints, tmp_path):
    for step, score in [(2, 0.5), (4, 0.3), (6, 0.4), (8, None)]:
        save(checkpoints, step, score)
    checkpoints.close()
    latest, best, score = reopened(tmp_path)
    assert bitwise(latest, state(8))
    assert bitwise(best, state(4))
    assert score == pytest.approx(0.3)


def test_the_best_is_written_before_the_latest(checkpoints, monkeypatch):
    """A run that ends in between goes on from the latest before, and finds it again."""
    save(checkpoints, 2, 0.5)

    def ended(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints._latest, "save", ended)
    with pytest.raises(KeyboardInterrupt):
        save(checkpoints, 4, 0.3)
    assert bitwise(checkpoints.restore_latest(LIKE), state(2))
    assert bitwise(checkpoints.restore_best(LIKE), state(4))


def test_an_equal_score_does_not_replace_the_best(checkpoints):
    save(checkpoints, 1, 0.5)
    save(checkpoints, 2, 0.5)
    assert bitwise(checkpoints.restore_best(LIKE), state(1))


def test_a_score_that_is_not_a_number_is_never_the_best(checkpoints):
    """Nor the first, against which every later one would lose."""
    save(checkpoints, 1, float("nan"))
    assert checkpoints.best_score() is None
    save(checkpoints, 2, 0.5)
    save(checkpoints, 3, float("nan"))
    assert bitwise(checkpoints.restore_best(LIKE), state(2))


def test_one_of_each_is_kept(checkpoints, tmp_path):
    for step in (1, 2, 3):
        save(checkpoints, step, 1.0 / step)
    checkpoints.close()
    for kind in ("latest", "best"):
        steps = [path.name for path in (tmp_path / "checkpoints" / kind).iterdir()]
        assert steps == ["3"]


def break_off(folder, step, temporary):
    """What a process leaves that is killed while it writes a step."""
    source = next(path for path in folder.iterdir() if path.name.isdigit())
    target = folder / (f"{step}.orbax-checkpoint-tmp" if temporary else f"{step}")
    shutil.copytree(source, target)
    files = sorted(path for path in target.rglob("*") if path.is_file())
    for path in files[::2]:
        path.unlink()
    for path in files[1::2]:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_write_that_was_killed_leaves_the_one_before(checkpoints, tmp_path):
    save(checkpoints, 4, 0.5)
    checkpoints.close()
    for kind in ("latest", "best"):
        break_off(tmp_path / "checkpoints" / kind, 8, temporary=True)
    latest, best, score = reopened(tmp_path)
    assert bitwise(latest, state(4))
    assert bitwise(best, state(4))
    assert score == pytest.approx(0.5)


def test_and_training_goes_on_over_it(checkpoints, tmp_path):
    save(checkpoints, 4, 0.5)
    checkpoints.close()
    break_off(tmp_path / "checkpoints" / "latest", 8, temporary=True)
    again = Checkpoints(tmp_path)
    save(again, 8, 0.4)
    again.close()
    latest, best, _ = reopened(tmp_path)
    assert bitwise(latest, state(8))
    assert bitwise(best, state(8))


def flipped(content):
    """Every seventh part of it has other bits."""
    content = bytearray(content)
    for i in range(0, len(content), max(1, len(content) // 7)):
        content[i] ^= 0x55
    return bytes(content)


# Orbax leaves its other reads unfinished when one fails.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("kind", ["latest", "best"])
def test_a_damaged_one_is_one_line(checkpoints, tmp_path, kind):
    """Whatever file it is, and however it was damaged, if it is needed at all."""
    save(checkpoints, 4, 0.5)
    checkpoints.close()
    folder = tmp_path / "checkpoints" / kind
    refused = 0
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        for damaged in (content[: len(content) // 2], flipped(content)):
            path.write_bytes(damaged)
            try:
                found = reopened(tmp_path)
                assert all(bitwise(each, state(4)) for each in found[:2]), path
            except InputError as error:
                assert str(error).startswith(f"{folder}: a damaged checkpoint")
                assert "\n" not in str(error)
                refused += 1
            path.write_bytes(content)
    assert refused >= 8
