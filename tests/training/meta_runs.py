"""Meta-trains the same on one device, and on four.

A program, which `test_parallel.py` runs with a folder and a file of weights. Trainings
are forked from a process that has run nothing.
"""

import multiprocessing
import os
import pathlib
import sys

import jax
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parents[2]))

from experiments.run_folder import open_run
from prism_jax.adaptation.config import MetaConfig
from prism_jax.completion.weights import load_pretrained
from prism_jax.training import meta
from prism_jax.training.config import MetaTrainConfig
from prism_jax.training.meta import meta_phase
from prism_jax.training.phase import Data, train_phase
from tests import stand_in_networks
from tests.training.conftest import Boxes

BATCH, STEPS, BROKEN_AT = 8, 3, 1
METHOD = MetaConfig(
    lambda_aux=0.1,
    weight_rule="meta",
    rehearse_depth=True,
    learn_steps=True,
    learn_auxiliary=True,
)
# Rates that move every kind of parameter by far more than the comparison allows.
CONFIG = MetaTrainConfig(
    METHOD,
    num_samples=STEPS * BATCH,
    batch_size=BATCH,
    num_complete=128,
    learning_rate=1e-2,
    clip_norm=1.0,
    refiner_rate=1e-2,
    auxiliary_rate=1e-2,
    weight_rate=0.1,
    average_decay=0.5,
)


def train(folder, weights, devices):
    """Trains; on several devices broken off and resumed. Leaves the state each time."""
    flags = os.environ.get("XLA_FLAGS", "")
    count = f"--xla_force_host_platform_device_count={devices}"
    os.environ["XLA_FLAGS"] = f"{flags} {count}"
    assert jax.device_count() == devices
    config, variables = load_pretrained(str(weights))
    config = config.with_adapt(step_size=0.1)
    # What is validated is no matter here: a stand-in compiles to nothing.
    meta.make_adapt = stand_in_networks.make_adapt
    # One phase, whose programs are compiled once.
    phase = meta_phase(variables, config, CONFIG, seed=0)
    points = config.model.backbone.num_points
    data = Data(Boxes(20, 0), Boxes(10, 1), points, 1.4, 7, BATCH)
    for steps in (BROKEN_AT, STEPS) if devices > 1 else (STEPS,):
        open_run(str(folder), {}, 0, resume=True)
        trained = train_phase(phase, data, folder, steps if steps < STEPS else None)
        leaves = jax.tree_util.tree_leaves_with_path(trained)
        arrays = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}
        np.savez(f"{folder}.{steps}.npz", **arrays)


def main():
    root, weights = map(pathlib.Path, sys.argv[1:])
    fork = multiprocessing.get_context("fork").Process
    for name, devices in (("one", 1), ("four", 4)):
        process = fork(target=train, args=(root / name, weights, devices))
        process.start()
        process.join()
        if process.exitcode:
            sys.exit(f"{name}: exit status {process.exitcode}")


if __name__ == "__main__":
    main()
