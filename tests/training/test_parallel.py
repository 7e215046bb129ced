"""One training, on however many devices."""

import multiprocessing
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from experiments.run_folder import open_run
from prism_jax.adaptation.config import MetaConfig
from prism_jax.completion.weights import load_pretrained, save_weights
from prism_jax.io.errors import InputError
from prism_jax.training import meta, parallel
from prism_jax.training.config import MetaTrainConfig
from prism_jax.training.phase import Data, TrainState, train_phase
from tests import stand_in_networks
from tests.training.conftest import Boxes, lines, regression_phase
from tests.trees import bitwise, equal

TOLERANCE = 1e-5
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
    phase = meta.meta_phase(variables, config, CONFIG, seed=0)
    points = config.model.backbone.num_points
    data = Data(Boxes(20, 0), {"boxes": Boxes(10, 1)}, points, 1.4, 7, BATCH)
    for steps in (BROKEN_AT, STEPS) if devices > 1 else (STEPS,):
        open_run(str(folder), {}, 0, resume=True)
        trained = train_phase(phase, data, folder, steps if steps < STEPS else None)
        leaves = jax.tree_util.tree_leaves_with_path(trained)
        arrays = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}
        np.savez(f"{folder}.{steps}.npz", **arrays)


def main(root, weights):
    """Meta-trains the same on one device, and on four. A program, whose trainings are
    forked from a process that has run nothing."""
    fork = multiprocessing.get_context("fork").Process
    for name, devices in (("one", 1), ("four", 4)):
        process = fork(target=train, args=(root / name, weights, devices))
        process.start()
        process.join()
        if process.exitcode:
            sys.exit(f"{name}: exit status {process.exitcode}")


def test_a_batch_is_split_and_a_state_is_not():
    """What is not there stays that."""
    assert list(parallel.data_mesh().devices) == jax.devices()
    batch = {"a": np.ones((8, 3), np.float32), "b": np.arange(8, dtype=np.uint16)}
    shared = parallel.share({**batch, "none": None})
    state = TrainState(jnp.int32(3), {"params": {"w": np.ones(2)}}, (), None)
    again = parallel.replicate(parallel.replicate(state))
    assert jax.tree.structure(again) == jax.tree.structure(state)
    assert shared.pop("none") is None
    for tree, axes in ((shared, [parallel.DATA]), (again, [])):
        found = {leaf.sharding.spec for leaf in jax.tree.leaves(tree)}
        assert found == {PartitionSpec(*axes)}
    assert bitwise(shared, batch)
    assert equal(again, state)


def test_a_batch_that_is_not_shared_evenly_is_refused_before_anything_is_written(
    examples, validation_examples, tmp_path, monkeypatch
):
    monkeypatch.setattr(jax, "device_count", lambda: 8)
    parallel.check_batch(64)
    phase = regression_phase(12, 4, 0.05)
    data = Data(examples, {"boxes": validation_examples}, 64, 1.4, 7, 48)
    with pytest.raises(InputError, match="12 examples cannot be split evenly across 8"):
        train_phase(phase, data, tmp_path)
    assert not list(tmp_path.iterdir())


def left(folder, name, step=3):
    """Best variables, last state and more, by their place in `Trained`."""
    with np.load(folder / f"{name}.{step}.npz") as arrays:
        return dict(arrays)


@pytest.mark.slow
def test_four_devices_broken_off_and_resumed_train_as_one(
    minimal, minimal_variables, tmp_path
):
    weights = tmp_path / "start.safetensors"
    save_weights(weights, minimal.config, minimal_variables, {})
    command = [sys.executable, __file__, tmp_path, weights]
    root = str(pathlib.Path(__file__).parents[2])
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": root}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    one, four = left(tmp_path, "one"), left(tmp_path, "four")
    # What learns moves by far more than the tolerance, and nothing else moves.
    moved = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(minimal_variables):
        name = f".last.variables{jax.tree_util.keystr(path)}"
        kind = "/".join(step.key for step in path[:2])
        moved[kind] = max(moved.get(kind, 0.0), np.abs(one[name] - leaf).max())
    parts = {name for name in moved if not name.startswith("batch_stats")}
    assert {kind for kind, by in moved.items() if by > 30 * TOLERANCE} == parts
    assert {kind for kind, by in moved.items() if by > 0} == parts
    # After one step it was broken off.
    early = left(tmp_path, "four", step=1)
    assert early[".last.step"] == 1 and not early[".done"]
    assert four.keys() == one.keys()
    for name, array in one.items():
        np.testing.assert_allclose(
            four[name], array, rtol=TOLERANCE, atol=TOLERANCE, err_msg=name
        )
    # Each step is logged once, whoever validated which example.
    for a, b in zip(lines(tmp_path / "four"), lines(tmp_path / "one"), strict=True):
        assert a.keys() == b.keys()
        for name in ("step", "samples", "losses", "validation"):
            told = pytest.approx(b.get(name, {}), rel=1e-4, abs=TOLERANCE)
            assert a.get(name, {}) == told


if __name__ == "__main__":
    main(*map(pathlib.Path, sys.argv[1:]))
