"""Meta-trains the same on one device, and on four of two processes.

A program, not a test: `test_parallel.py` runs it with a folder and a file of weights,
and looks at what it leaves there. The trainings are forked from one process that has
imported everything and run nothing.
"""

import json
import multiprocessing
import os
import pathlib
import socket
import sys

import jax
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parents[2]))

from prism_jax.adaptation.config import MetaConfig
from prism_jax.training.config import MetaTrainConfig
from prism_jax.training.meta import meta_phase
from prism_jax.training.phase import Data, train_phase
from prism_jax.training.run import open_run
from prism_jax.weights import load_pretrained
from tests.training.conftest import Boxes

BATCH, STEPS, BROKEN_AT = 8, 5, 2
# Rates that move every kind of parameter by far more than the comparison allows.
CONFIG = MetaTrainConfig(
    MetaConfig(num_steps=1, lambda_aux=0.1, learn_steps=True),
    num_samples=STEPS * BATCH,
    batch_size=BATCH,
    num_complete=128,
    learning_rate=1e-2,
    clip_norm=1.0,
    refiner_rate=1e-2,
    weight_rate=0.1,
    average_decay=0.5,
)


def train(folder, weights, devices, coordinator, processes, process):
    """As one process of several, broken off and resumed. Leaves the state of both
    times, and which files of the run's folder this process wrote, checkpoints apart."""
    flags = os.environ.get("XLA_FLAGS", "")
    count = f"--xla_force_host_platform_device_count={devices}"
    os.environ["XLA_FLAGS"] = f"{flags} {count}"
    if processes > 1:
        jax.distributed.initialize(coordinator, processes, process)
    assert jax.device_count() == devices * processes
    written = set()

    def note(event, arguments):
        if event == "open" and isinstance(arguments[0], str | os.PathLike):
            path, mode = os.fspath(arguments[0]), arguments[1] or ""
            if path.startswith(f"{folder}/") and set(mode) & set("wxa+"):
                written.add(path.removeprefix(f"{folder}/"))

    sys.addaudithook(note)
    config, variables = load_pretrained(str(weights))
    # One phase, whose programs are compiled once.
    phase = meta_phase(variables, config, CONFIG, seed=0)
    points = config.model.backbone.num_points
    data = Data(Boxes(20, 0), Boxes(10, 1), points, 1.4, 7, 16)
    for steps in (BROKEN_AT, STEPS) if processes > 1 else (STEPS,):
        written.clear()
        open_run(str(folder), {}, 0, resume=True)
        trained = train_phase(phase, data, folder, steps if steps < STEPS else None)
        wrote = sorted(name for name in written if "/checkpoints/" not in name)
        name = f"{folder}.{process}.{steps}"
        pathlib.Path(f"{name}.json").write_text(json.dumps(wrote))
        leaves = jax.tree_util.tree_leaves_with_path(trained)
        arrays = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}
        np.savez(f"{name}.npz", **arrays)
    if processes > 1:
        # As JAX does when a program ends, which a forked process leaves out: without it
        # the first process may be gone before the others are, and they die of that.
        jax.distributed.shutdown()


def run(folder, weights, devices=1, processes=1):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}"
    common = folder, weights, devices, coordinator, processes
    fork = multiprocessing.get_context("fork").Process
    forked = [fork(target=train, args=(*common, n)) for n in range(processes)]
    for process in forked:
        process.start()
    for process in forked:
        process.join()
        if process.exitcode:
            sys.exit(f"{folder.name}: exit status {process.exitcode}")


def main():
    root, weights = map(pathlib.Path, sys.argv[1:])
    run(root / "one", weights)
    run(root / "four", weights, devices=2, processes=2)


if __name__ == "__main__":
    main()
