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
from prism_jax.training.phase import Data, TrainState, train_phase
from tests.training.conftest import regression_phase
from tests.trees import bitwise, equal

SCRIPT = pathlib.Path(__file__).with_name("meta_runs.py")
TOLERANCE = 1e-5


def test_a_batch_is_split_and_a_state_is_not():
    """What is not there stays that."""
    mesh = parallel.data_mesh()
    assert list(mesh.devices) == jax.devices()
    batch = {"a": np.ones((8, 3), np.float32), "b": np.arange(8, dtype=np.uint16)}
    shared = parallel.share({**batch, "none": None}, mesh)
    state = TrainState(jnp.int32(3), {"params": {"w": np.ones(2)}}, (), None)
    again = parallel.replicate(parallel.replicate(state, mesh), mesh)
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
    data = Data(examples, validation_examples, 64, 1.4, 7, 48)
    with pytest.raises(InputError, match="12 examples cannot be split evenly across 8"):
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
    found, expected = lines(tmp_path, "four"), lines(tmp_path, "one")
    for a, b in zip(found, expected, strict=True):
        assert a.keys() == b.keys()
        for name in ("step", "samples", "losses", "validation"):
            told = pytest.approx(b.get(name, {}), rel=1e-4, abs=TOLERANCE)
            assert a.get(name, {}) == told
