"""Trainings that are killed, and end as if they had not been."""

import json
import math
import multiprocessing
import os
import pathlib
import random
import signal
import subprocess
import sys

import jax
import pytest

from experiments.run_folder import open_run
from prism_jax.completion.weights import sha256
from prism_jax.training.phase import Data, train_phase
from tests.training.conftest import Boxes, lines, regression_phase

BATCH, STEPS, EVERY, KILLS = 4, 24, 2, 8
# Changes of its folder that a killed training may get to: about as many as two saves
# make, so that all the kills together end no training.
CHANGES = 150


def train(folder, dies_at):
    """To the end, which it notes, or to so many changes of the folder."""
    count = 0

    def die(event, arguments):
        nonlocal count
        if event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir") or (
            event == "open" and str(arguments[0]).startswith(str(folder))
        ):
            count += 1
            if count >= dies_at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(die)
    open_run(str(folder), {}, 0, resume=True)
    data = Data(Boxes(20, 0), {"boxes": Boxes(10, 1)}, 64, 1.4, 7, EVERY * BATCH)
    trained = train_phase(regression_phase(BATCH, STEPS, 0.5), data, folder)
    leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(trained.last))}
    ended = {"state": sha256(leaves), "best": sha256(trained.best)}
    ended["last"] = sha256(trained.last.variables)
    (folder / "ended.json").write_text(json.dumps(ended))


def run(folder, dies_at=math.inf):
    """How a training ended, and whether in a save."""
    fork = multiprocessing.get_context("fork").Process
    process = fork(target=train, args=(folder, dies_at))
    process.start()
    process.join()
    return process.exitcode, any(folder.glob("toy/checkpoints/*/*tmp*"))


def main(root):
    """Trains once unbroken and once with many kills. A program, whose trainings are
    forked from a process that has run nothing."""
    rng = random.Random(0)
    run(root / "unbroken")
    kills = [run(root / "killed", rng.randint(1, CHANGES)) for _ in range(KILLS)]
    run(root / "killed")
    print(json.dumps(kills))


def left(folder):
    """What a training ended with, and the lines that it logged, without times."""
    kept = ("phase", "step", "losses", "validation")
    logged = [[line.get(name) for name in kept] for line in lines(folder)]
    return json.loads((folder / "ended.json").read_text()), logged


@pytest.mark.slow
def test_a_training_that_is_killed_ends_as_an_unbroken_one(tmp_path):
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = str(pathlib.Path(__file__).parents[2])
    command = [sys.executable, __file__, tmp_path]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    statuses, in_save = zip(*json.loads(done.stdout), strict=True)
    assert set(statuses) == {-signal.SIGKILL} and sum(in_save) >= 3
    assert left(tmp_path / "killed") == left(tmp_path / "unbroken")
    assert not [path for path in tmp_path.rglob("*") if "tmp" in path.name]


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
