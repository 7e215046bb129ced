"""Trains once unbroken and once with many kills, in folders of its first argument.

A program, which `test_killed.py` runs. Trainings are forked from a process that has run
nothing.
"""

import json
import math
import multiprocessing
import os
import pathlib
import random
import signal
import sys

import jax

sys.path.insert(0, str(pathlib.Path(__file__).parents[2]))

from experiments.run_folder import open_run
from prism_jax.completion.weights import sha256
from prism_jax.training.phase import Data, train_phase
from tests.training.conftest import Boxes, regression_phase

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
    data = Data(Boxes(20, 0), Boxes(10, 1), 64, 1.4, 7, EVERY * BATCH)
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


def main():
    root, rng = pathlib.Path(sys.argv[1]), random.Random(0)
    run(root / "unbroken")
    kills = [run(root / "killed", rng.randint(1, CHANGES)) for _ in range(KILLS)]
    run(root / "killed")
    print(json.dumps(kills))


if __name__ == "__main__":
    main()
