"""Trains once unbroken and once with many kills, in folders of its first argument.

A program, not a test: `test_killed.py` runs it and looks at what it leaves. Trainings
are forked from one process that has imported everything and run nothing.
"""

import json
import math
import multiprocessing
import os
import pathlib
import random
import signal
import sys
import time

import jax
import jax.numpy as jnp
import optax

sys.path.insert(0, str(pathlib.Path(__file__).parents[2]))

from prism_jax.completion.weights import sha256
from prism_jax.training.phase import Data, Phase, TrainState, train_phase
from prism_jax.training.run import open_run
from tests.training.conftest import Boxes

BATCH, STEPS, EVERY = 4, 40, 2
# Changes of its folder that a killed training gets to. Two saves make about as many,
# and all the kills together end no training.
CHANGES = 150
BALLAST = 500_000
OPTIMISER = optax.adam(0.3)


def toy_phase():
    """Fits the eye as a multiple, per axis, of the partial's mean. The ballast makes
    saving take long, and tells of every step that was left out or made twice."""

    def error(params, batch):
        return jnp.mean((batch.partial.mean(1) * params["w"] - batch.eye) ** 2)

    @jax.jit
    def step(state, batch):
        params = state.variables["params"]
        loss, grads = jax.value_and_grad(error)(params, batch)
        updates, opt_state = OPTIMISER.update(grads, state.opt_state)
        variables = {
            "params": optax.apply_updates(params, updates),
            "ballast": {"b": jnp.sin(state.variables["ballast"]["b"] + loss)},
        }
        return TrainState(state.step + 1, variables, opt_state), loss[None]

    @jax.jit
    def validate(variables, batch):
        # Which the parameters come near on their way, and leave behind.
        score = jnp.mean((variables["params"]["w"] - 3.0) ** 2)
        return jnp.full((len(batch.eye), 1), score)

    params, ballast = {"w": jnp.zeros(3)}, {"b": jnp.linspace(-1, 1, BALLAST)}
    start = TrainState(
        jnp.int32(0), {"params": params, "ballast": ballast}, OPTIMISER.init(params)
    )
    names = ("loss",), ("score",)
    return Phase("toy", STEPS * BATCH, BATCH, 128, start, step, validate, *names)


def train(folder, how, dies_at):
    """To the end, which it notes; or until it is killed, for which it waits before it
    has come too far: "in a save", before its first save is whole, and else after so
    many changes of the folder."""
    begun = 0

    def wait_or_die(event, arguments):
        nonlocal begun
        if event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir") or (
            event == "open" and str(arguments[0]).startswith(str(folder))
        ):
            begun += 1
            if begun >= dies_at:
                os.kill(os.getpid(), signal.SIGKILL)
            save_is_whole = event == "os.rename" and "checkpoint" in str(arguments[0])
            while begun >= CHANGES or (how == "in a save" and save_is_whole):
                time.sleep(1)

    if how:
        sys.addaudithook(wait_or_die)
    open_run(str(folder), {}, 0, resume=True)
    data = Data(Boxes(20, 0), Boxes(10, 1), 64, 1.4, 7, EVERY * BATCH)
    trained = train_phase(toy_phase(), data, folder)
    leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(trained.last))}
    ended = {
        "last": sha256(trained.last.variables),
        "state": sha256(leaves),
        "best": sha256(trained.best),
    }
    (folder / "ended.json").write_text(json.dumps(ended))


def start(folder, how=None, dies_at=math.inf):
    process = multiprocessing.get_context("fork").Process(
        target=train, args=(folder, how, dies_at)
    )
    process.start()
    return process


def half_written(folder):
    """Checkpoints that are being written, or were when their writer was killed."""
    found = {path: path.stat() for path in folder.glob("toy/checkpoints/*/*tmp*")}
    return {(path.name, at.st_ino, at.st_mtime_ns) for path, at in found.items()}


def kill(folder, how, rng, seconds):
    """Starts a training and kills it. Returns how it ended, whether in a save, and at
    which step the next one begins."""
    before = half_written(folder)
    dies_at = rng.randint(1, CHANGES) if how == "at a change" else math.inf
    process = start(folder, how, dies_at)
    if how == "at a moment":
        process.join(rng.uniform(0, seconds / 3))
    elif how == "in a save":
        while process.is_alive() and half_written(folder) <= before:
            time.sleep(1e-3)
    if how != "at a change":
        process.kill()
    process.join()
    steps = (folder / "toy" / "checkpoints" / "latest").glob("[0-9]*")
    done = [int(path.name) for path in steps if path.name.isdigit()]
    in_save = not half_written(folder) <= before
    return {
        "status": process.exitcode,
        "in_save": in_save,
        "step": max(done, default=0),
    }


def main():
    root, rng = pathlib.Path(sys.argv[1]), random.Random(0)
    began = time.monotonic()
    start(root / "unbroken").join()
    seconds = time.monotonic() - began
    hows = ["at a change"] * 8 + ["in a save"] * 3 + ["at a moment"] * 3
    rng.shuffle(hows)
    kills = [kill(root / "killed", how, rng, seconds) for how in hows]
    start(root / "killed").join()
    print(json.dumps(kills))


if __name__ == "__main__":
    main()
