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


@pytest.fixture
def mesh():
    return parallel.data_mesh()


def test_the_mesh_has_all_devices_in_a_row(mesh):
    assert mesh.axis_names == (parallel.DATA,)
    assert list(mesh.devices) == jax.devices()


def test_a_batch_is_shared_as_it_is(mesh):
    batch = {"a": np.arange(24.0, dtype=np.float32).reshape(8, 3), "b": np.arange(8)}
    batch["c"] = np.arange(8, dtype=np.uint16)
    shared = parallel.share(batch, mesh)
    for name, rows in batch.items():
        assert shared[name].sharding.spec == PartitionSpec(parallel.DATA)
        expected = jnp.asarray(rows)
        assert shared[name].dtype == expected.dtype
        assert np.array_equal(shared[name], expected)


def test_what_is_not_there_is_shared_as_that(mesh):
    assert parallel.share((np.ones(2), None), mesh)[1] is None


@pytest.mark.parametrize("place", [np.asarray, jnp.asarray])
def test_a_state_is_the_same_on_every_device(mesh, place):
    state = TrainState(jnp.int32(3), {"params": {"w": place([1.0, 2.0])}}, (), None)
    placed = parallel.replicate(state, mesh)
    assert jax.tree.structure(placed) == jax.tree.structure(state)
    for before, after in zip(*map(jax.tree.leaves, (state, placed)), strict=True):
        assert after.sharding.spec == PartitionSpec()
        assert after.sharding.mesh == mesh
        assert np.array_equal(before, after)
    again = parallel.replicate(placed, mesh)
    assert np.array_equal(again.kept["params"]["w"], [1.0, 2.0])


@pytest.fixture
def eight_devices(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 8)


@pytest.mark.parametrize("size", [8, 16, 64])
def test_a_batch_that_is_shared_evenly(eight_devices, size):
    parallel.check_batch(size)


@pytest.mark.parametrize("size", [1, 4, 12, 31])
def test_a_batch_that_is_not(eight_devices, size):
    fault = f"^batch_size: {size} examples cannot be split evenly across 8 devices; "
    with pytest.raises(InputError, match=fault + "use a multiple of the number"):
        parallel.check_batch(size)


def test_it_is_refused_before_anything_is_written(
    eight_devices, examples, validation_examples, tmp_path
):
    def never(*arguments):
        raise AssertionError("trained")

    start = TrainState(jnp.int32(0), {"params": {"w": jnp.zeros(3)}}, ())
    phase = Phase("toy", 48, 12, 128, start, never, never, ("loss",), ("score",))
    data = Data(examples, validation_examples, 64, 1.4, 7, 48)
    with pytest.raises(InputError, match="12 examples cannot be split"):
        train_phase(phase, data, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def runs(minimal, minimal_variables, tmp_path_factory):
    """The folder of what `meta_runs.py` leaves."""
    folder = tmp_path_factory.mktemp("runs")
    weights = folder / "start.safetensors"
    save_weights(weights, minimal.config, minimal_variables, {})
    command = [sys.executable, SCRIPT, folder, weights]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return folder


def left(runs, name, step=5):
    """Best variables, last state and more, by their place in `Trained`."""
    with np.load(runs / f"{name}.{step}.npz") as arrays:
        return dict(arrays)


def lines(runs, name):
    text = (runs / name / "metrics.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


def same(found, expected):
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_allclose(
            found[name], array, rtol=TOLERANCE, atol=TOLERANCE, err_msg=name
        )


@pytest.mark.slow
def test_five_steps_move_what_learns_by_more_than_the_tolerance(
    runs, minimal_variables
):
    """Or the comparisons would tell nothing."""
    after = left(runs, "one")
    moved = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(minimal_variables):
        name = f".last.variables{jax.tree_util.keystr(path)}"
        kind = "/".join(step.key for step in path[:2])
        distance = np.abs(after[name] - leaf).max()
        moved[kind] = max(moved.get(kind, 0.0), distance)
    learning = {
        *(f"params/{name}" for name in ("point_encoder", "depth_encoder", "decoder")),
        "params/refiner",
        *(f"weighting/{name}" for name in ("logits", "scales", "log_steps")),
    }
    assert {kind for kind, by in moved.items() if by > 30 * TOLERANCE} == learning
    assert {kind for kind, by in moved.items() if by > 0} == learning


@pytest.mark.slow
def test_four_devices_broken_off_and_resumed_train_as_one(runs):
    assert left(runs, "four", step=2)[".last.step"] == 2
    assert not left(runs, "four", step=2)[".done"]
    same(left(runs, "four"), left(runs, "one"))


@pytest.mark.slow
def test_they_log_the_same(runs):
    """Each step once, whoever validated which example."""
    found, expected = lines(runs, "four"), lines(runs, "one")
    keys = [
        [(line["step"], line["samples"], "losses" in line) for line in of]
        for of in (found, expected)
    ]
    assert keys[0] == keys[1] == sorted(set(keys[0]), key=keys[0].index)
    for kind in ("losses", "validation"):
        for a, b in zip(found, expected, strict=True):
            told = pytest.approx(b.get(kind, {}), rel=1e-4, abs=TOLERANCE)
            assert a.get(kind, {}) == told
