"""One training, on however many devices."""

import json
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from prism_jax.completion.weights import save_weights
from prism_jax.io.errors import InputError
from prism_jax.training import parallel
from prism_jax.training.phase import Data, Phase, TrainState, train_phase

SCRIPT = pathlib.Path(__file__).with_name("meta_runs.py")
TOLERANCE = 1e-5


def test_a_batch_is_shared_as_it_is():
    """Over all devices in a row; what is not there is shared as that."""
    mesh = parallel.data_mesh()
    assert list(mesh.devices) == jax.devices()
    batch = {"a": np.arange(24.0, dtype=np.float32).reshape(8, 3), "none": None}
    batch["c"] = np.arange(8, dtype=np.uint16)
    shared = parallel.share(batch, mesh)
    assert shared.pop("none") is batch.pop("none")
    for name, rows in batch.items():
        assert shared[name].sharding.spec == PartitionSpec(parallel.DATA)
        assert shared[name].dtype == rows.dtype
        assert np.array_equal(shared[name], rows)


@pytest.mark.parametrize("place", [np.asarray, jnp.asarray])
def test_a_state_is_the_same_on_every_device(place):
    mesh = parallel.data_mesh()
    state = TrainState(jnp.int32(3), {"params": {"w": place([1.0, 2.0])}}, (), None)
    again = parallel.replicate(parallel.replicate(state, mesh), mesh)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    for before, after in zip(*map(jax.tree.leaves, (state, again)), strict=True):
        assert after.sharding.spec == PartitionSpec()
        assert after.sharding.mesh == mesh
        assert np.array_equal(before, after)


def test_a_batch_that_is_not_shared_evenly_is_refused_before_anything_is_written(
    examples, validation_examples, tmp_path, monkeypatch
):
    monkeypatch.setattr(jax, "device_count", lambda: 8)
    for size in (8, 64):
        parallel.check_batch(size)

    def never(*arguments):
        raise AssertionError("trained")

    start = TrainState(jnp.int32(0), {"params": {"w": jnp.zeros(3)}}, ())
    data = Data(examples, validation_examples, 64, 1.4, 7, 48)
    for size in (4, 12):
        phase = Phase("toy", 48, size, 128, start, never, never, ("loss",), ("score",))
        fault = f"^batch_size: {size} examples cannot be split evenly across 8 devices"
        with pytest.raises(InputError, match=fault):
            train_phase(phase, data, tmp_path)
    assert not list(tmp_path.iterdir())


def left(folder, name, step=3):
    """Best variables, last state and more, by their place in `Trained`."""
    with np.load(folder / f"{name}.{step}.npz") as arrays:
        return dict(arrays)


def lines(folder, name):
    text = (folder / name / "metrics.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.slow
def test_four_devices_broken_off_and_resumed_train_as_one(
    minimal, minimal_variables, tmp_path
):
    weights = tmp_path / "start.safetensors"
    save_weights(weights, minimal.config, minimal_variables, {})
    command = [sys.executable, SCRIPT, tmp_path, weights]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    one, four = left(tmp_path, "one"), left(tmp_path, "four")
    # What learns moves by more than the tolerance, or the comparison would tell
    # nothing; and nothing else moves.
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
    found, expected = lines(tmp_path, "four"), lines(tmp_path, "one")
    for a, b in zip(found, expected, strict=True):
        assert a.keys() == b.keys()
        for name in ("step", "samples", "losses", "validation"):
            told = pytest.approx(b.get(name, {}), rel=1e-4, abs=TOLERANCE)
            assert a.get(name, {}) == told
