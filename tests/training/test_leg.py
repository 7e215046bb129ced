"""The training loop, around legs so small that they compile to nothing."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from prism_jax.training.batches import make_batch
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.leg import VALIDATION_COMPLETE, Leg, Source, TrainState
from prism_jax.training.leg import train_leg as train

BATCH, STEPS, MARGIN = 4, 12, 1.4
OPTIMISER = optax.adam(0.05)


@pytest.fixture
def source(examples, validation_examples):
    """Validation comes every fourth step."""
    return Source(examples, validation_examples, 64, MARGIN, 7, 4 * BATCH)


def make_leg(step_fn, validate_fn, num_steps=STEPS):
    variables = {"params": {"w": jnp.zeros(3)}}
    start = TrainState(jnp.int32(0), variables, OPTIMISER.init(variables["params"]))
    return Leg("toy", num_steps * BATCH, BATCH, 128, start, step_fn, validate_fn)


@pytest.fixture(scope="module")
def regression():
    """Fits the eye as a multiple, per axis, of the partial's mean."""

    def errors(params, batch):
        return ((batch.partial.mean(1) * params["w"] - batch.eye) ** 2).mean(-1)

    @jax.jit
    def step(state, batch):
        params = state.variables["params"]
        loss, grads = jax.value_and_grad(lambda p: errors(p, batch).mean())(params)
        updates, opt_state = OPTIMISER.update(grads, state.opt_state)
        variables = {"params": optax.apply_updates(params, updates)}
        return TrainState(state.step + 1, variables, opt_state), loss[None]

    @jax.jit
    def validate(variables, batch):
        return jnp.stack([batch.half_extent, errors(variables["params"], batch)], -1)

    return make_leg(step, validate)


def counting(scores):
    """A leg whose only parameter is the step number, and whose score is a table's."""

    def step(state, batch):
        variables = {"params": {"w": state.variables["params"]["w"] + 1}}
        return state._replace(step=state.step + 1, variables=variables), jnp.ones(1)

    def validate(variables, batch):
        score = jnp.asarray(scores)[variables["params"]["w"][0].astype(int)]
        return jnp.full((len(batch.eye), 1), score)

    return make_leg(step, validate)


def lines(folder):
    text = (folder / "metrics.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


def bitwise(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in leaves)


def latest(leg, folder):
    checkpoints = Checkpoints(folder / leg.name)
    state = checkpoints.restore_latest(leg.start)
    checkpoints.close()
    return state


def test_it_learns(regression, source, tmp_path):
    variables, done = train(regression, source, tmp_path)
    assert done
    losses = [line["losses"][0] for line in lines(tmp_path) if "losses" in line]
    assert losses[-1] < losses[0]
    assert bitwise(variables, latest(regression, tmp_path).variables)


@pytest.mark.parametrize("broken_at", [[4], [3, 5], [1, 1, 1]])
def test_broken_off_and_resumed_it_ends_the_same(
    regression, source, tmp_path, broken_at
):
    expected, _ = train(regression, source, tmp_path / "unbroken")
    for steps in broken_at:
        _, done = train(regression, source, tmp_path / "broken", max_steps=steps)
        assert not done
    assert int(latest(regression, tmp_path / "broken").step) == sum(broken_at)
    variables, done = train(regression, source, tmp_path / "broken")
    assert done
    assert bitwise(variables, expected)
    # Moments and step count of the optimiser too.
    ends = [latest(regression, tmp_path / name) for name in ("unbroken", "broken")]
    assert bitwise(*ends)


def test_killed_between_checkpoints_it_repeats_what_was_lost(
    regression, source, tmp_path
):
    expected, _ = train(regression, source, tmp_path / "unbroken")
    calls = []

    def dying(state, batch):
        calls.append(int(state.step))
        if len(calls) == 7:
            raise KeyboardInterrupt
        return regression.step_fn(state, batch)

    with pytest.raises(KeyboardInterrupt):
        train(regression._replace(step_fn=dying), source, tmp_path / "killed")
    assert int(latest(regression, tmp_path / "killed").step) == 4
    variables, done = train(
        regression._replace(step_fn=dying), source, tmp_path / "killed"
    )
    assert done
    assert calls[6:] == [6, 4, 5, 6, 7, 8, 9, 10, 11]
    assert bitwise(variables, expected)


def test_every_step_has_the_state_of_one_compilation(regression, source, tmp_path):
    train(regression, source, tmp_path, max_steps=5)
    train(regression, source, tmp_path)
    assert regression.step_fn._cache_size() == 1
    assert regression.validate_fn._cache_size() == 1


def test_what_did_best_on_validation_is_kept(source, tmp_path):
    scores = np.full(STEPS + 1, 9.0)
    scores[[4, 8, 12]] = 0.5, 0.2, 0.4
    variables, _ = train(counting(scores), source, tmp_path)
    assert np.array_equal(variables["params"]["w"], [8, 8, 8])
    assert int(latest(counting(scores), tmp_path).step) == STEPS


def test_a_score_that_is_not_a_number_is_not_kept(source, tmp_path):
    scores = np.full(STEPS + 1, np.nan)
    scores[8] = 3.0
    variables, _ = train(counting(scores), source, tmp_path)
    assert np.array_equal(variables["params"]["w"], [8, 8, 8])


def test_a_finished_leg_is_not_trained_again(regression, source, tmp_path):
    expected, _ = train(regression, source, tmp_path)

    def never(*arguments):
        raise AssertionError("trained")

    finished = regression._replace(step_fn=never, validate_fn=never)
    variables, done = train(finished, source, tmp_path)
    assert done
    assert bitwise(variables, expected)


def test_validation_counts_every_example_once(regression, source, tmp_path):
    """Ten of them, in batches of four."""
    train(regression, source, tmp_path, max_steps=1)
    scores = [line["validation"] for line in lines(tmp_path) if "validation" in line]
    everything = source.validation
    rows = np.arange(10)
    batch = make_batch(everything, rows, 64, VALIDATION_COMPLETE, MARGIN)
    assert scores[0][0] == pytest.approx(batch.half_extent.mean(), rel=1e-6)


def test_a_loss_that_is_not_finite_ends_it(regression, source, tmp_path):
    def broken(state, batch):
        state, loss = regression.step_fn(state, batch)
        return state, jnp.where(state.step == 6, jnp.nan, loss)

    with pytest.raises(FloatingPointError, match=r"toy: loss .*nan"):
        train(regression._replace(step_fn=broken), source, tmp_path)
    # The state before it is there to go on from.
    assert int(latest(regression, tmp_path).step) == 4


def test_the_log_tells_losses_and_validation(regression, source, tmp_path):
    train(regression, source, tmp_path)
    written = lines(tmp_path)
    assert [line["step"] for line in written if "validation" in line] == [4, 8, 12]
    assert [line["samples"] for line in written if "losses" in line] == [16, 32, 48]
    assert {line["phase"] for line in written} == {"toy"}


def test_another_seed_sees_other_batches(regression, source, tmp_path):
    first, _ = train(regression, source, tmp_path / "0")
    second, _ = train(regression, source._replace(seed=8), tmp_path / "1")
    assert not bitwise(first, second)
