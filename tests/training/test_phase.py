"""The training loop, around phases so small that they compile to nothing."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from prism_jax.data.pipeline import training_batches
from prism_jax.io.errors import InputError
from prism_jax.training import phase as training_phase
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.phase import (
    VALIDATION_COMPLETE,
    Data,
    Phase,
    TrainState,
    order_seed,
)
from prism_jax.training.phase import train_phase as train
from prism_jax.training.run import Log
from tests.trees import bitwise

BATCH, STEPS, MARGIN = 4, 12, 1.4
OPTIMISER = optax.adam(0.05)


@pytest.fixture
def data(examples, validation_examples):
    """Validation comes every fourth step."""
    return Data(examples, validation_examples, 64, MARGIN, 7, 4 * BATCH)


def make_phase(step_fn, validate_fn, count_scores=2, num_steps=STEPS):
    variables = {"params": {"w": jnp.zeros(3)}}
    start = TrainState(jnp.int32(0), variables, OPTIMISER.init(variables["params"]))
    size = num_steps * BATCH
    names = ("loss",), ("first", "last")[-count_scores:]
    return Phase("toy", size, BATCH, 128, start, step_fn, validate_fn, *names)


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
        return jnp.stack([batch.scale, errors(variables["params"], batch)], -1)

    return make_phase(step, validate)


def counting(scores):
    """A phase whose only parameter is the step number, and whose score is a table's."""

    def step(state, batch):
        variables = {"params": {"w": state.variables["params"]["w"] + 1}}
        return state._replace(step=state.step + 1, variables=variables), jnp.ones(1)

    def validate(variables, batch):
        score = jnp.asarray(scores)[variables["params"]["w"][0].astype(int)]
        return jnp.full((len(batch.eye), 1), score)

    return make_phase(step, validate, 1)


def lines(folder):
    text = (folder / "metrics.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


def latest(phase, folder):
    checkpoints = Checkpoints(folder / phase.name)
    state = checkpoints.restore_latest(phase.start)
    checkpoints.close()
    return state


def recording(phase, seen):
    """The phase, noting which batch each step is given."""

    def step(state, batch):
        seen.append((int(state.step), batch))
        return phase.step_fn(state, batch)

    return phase._replace(step_fn=step)


def test_it_learns_and_logs(regression, data, tmp_path):
    variables, last, done = train(regression, data, tmp_path)
    assert done
    written = lines(tmp_path)
    losses = [line["losses"]["loss"] for line in written if "losses" in line]
    assert losses[-1] < losses[0]
    assert [line["step"] for line in written if "validation" in line] == [4, 8, 12]
    assert [line["samples"] for line in written if "losses" in line] == [16, 32, 48]
    assert {line["phase"] for line in written} == {"toy"}
    assert all(0 <= line["data_wait"] <= 1 for line in written)
    assert bitwise(variables, latest(regression, tmp_path).variables)
    assert bitwise(last, latest(regression, tmp_path))


def test_broken_off_and_resumed_it_ends_the_same(regression, data, tmp_path):
    broken_at = (3, 8)
    expected, *_ = train(regression, data, tmp_path / "unbroken")
    for steps in broken_at:
        *_, done = train(regression, data, tmp_path / "broken", max_steps=steps)
        assert not done
    assert int(latest(regression, tmp_path / "broken").step) == broken_at[-1]
    variables, _, done = train(regression, data, tmp_path / "broken")
    assert done
    assert bitwise(variables, expected)
    # Moments and step count of the optimiser too.
    ends = [latest(regression, tmp_path / name) for name in ("unbroken", "broken")]
    assert bitwise(*ends)


def test_one_step_is_queued_and_no_more(regression, data, tmp_path, monkeypatch):
    """When the bar moves, all steps but the last are done."""
    queued = []

    @jax.jit
    def late(losses):
        square = jnp.full((512, 512), losses[0])
        work = jax.lax.fori_loop(0, 10, lambda _, x: x @ square / 512, square)
        return losses + 0.0 * work[0, 0]

    def step(state, batch):
        state, losses = regression.step_fn(state, batch)
        queued.append(late(losses))
        return state, queued[-1]

    def advance(log, samples):
        done.append([losses.is_ready() for losses in queued])

    done = []
    monkeypatch.setattr(Log, "advance", advance)
    train(regression._replace(step_fn=step), data, tmp_path)
    assert all(all(ready[:-1]) for ready in done)
    assert not all(ready[-1] for ready in done)


@pytest.mark.parametrize(("seconds", "kept"), [(120.0, 4), (-1.0, 6)])
def test_killed_between_checkpoints_it_repeats_what_was_lost(
    regression, data, tmp_path, monkeypatch, seconds, kept
):
    """Steps and batches alike, bit for bit; the last save is that of the validation, or
    that of the next log line when it is due."""
    unbroken, seen = [], []
    monkeypatch.setattr(training_phase, "LOG_EVERY", 3)
    expected, *_ = train(recording(regression, unbroken), data, tmp_path / "unbroken")
    remembering = recording(regression, seen)

    def dying(state, batch):
        if len(seen) == 7:
            raise KeyboardInterrupt
        return remembering.step_fn(state, batch)

    monkeypatch.setattr(training_phase, "SAVE_SECONDS", seconds)
    with pytest.raises(KeyboardInterrupt):
        train(regression._replace(step_fn=dying), data, tmp_path / "killed")
    assert int(latest(regression, tmp_path / "killed").step) == kept
    variables, _, done = train(remembering, data, tmp_path / "killed")
    assert done
    assert [step for step, _ in seen] == [*range(7), *range(kept, STEPS)]
    for step, batch in seen:
        assert bitwise(batch, unbroken[step][1])
    assert bitwise(variables, expected)


def test_the_batches_are_those_of_the_pipeline(data, tmp_path):
    """From the first on, over more than one epoch, and with what is known of each."""
    data = data._replace(indices=np.arange(20, dtype=np.uint16))
    seen = []
    phase = counting(np.ones(STEPS + 1))
    train(recording(phase, seen), data, tmp_path)
    seed = order_seed(data.seed, phase.name)
    batches = training_batches(
        data.train, data.framing(128), BATCH, seed, indices=data.indices
    )
    assert len(seen) == STEPS
    for _, batch in seen:
        assert bitwise(batch, next(batches))
        assert batch.partial.shape == (BATCH, 64, 3)
        assert batch.complete.shape == (BATCH, 128, 3)
    first_epoch = np.concatenate([batch.indices for _, batch in seen[:5]])
    assert np.array_equal(np.sort(first_epoch), np.arange(20))


def test_phases_are_told_apart_by_seed_and_name():
    seeds = [order_seed(seed, name) for name in ("seeds", "meta") for seed in (0, 1)]
    assert len(set(seeds)) == 4 and min(seeds) >= 0 and max(seeds) < 2**31


def test_every_step_has_the_state_of_one_compilation(regression, data, tmp_path):
    train(regression, data, tmp_path, max_steps=5)
    train(regression, data, tmp_path)
    assert regression.step_fn._cache_size() == 1
    assert regression.validate_fn._cache_size() == 1


def test_what_did_best_on_validation_is_kept(data, tmp_path):
    scores = np.full(STEPS + 1, 9.0)
    scores[[4, 8, 12]] = 0.5, 0.2, 0.4
    variables, *_ = train(counting(scores), data, tmp_path)
    assert np.array_equal(variables["params"]["w"], [8, 8, 8])
    assert int(latest(counting(scores), tmp_path).step) == STEPS


def test_a_score_that_is_not_a_number_is_not_kept(data, tmp_path):
    scores = np.full(STEPS + 1, np.nan)
    scores[8] = 3.0
    variables, *_ = train(counting(scores), data, tmp_path)
    assert np.array_equal(variables["params"]["w"], [8, 8, 8])


def test_a_finished_phase_is_not_trained_again(regression, data, tmp_path):
    expected, *_ = train(regression, data, tmp_path)

    def never(*arguments):
        raise AssertionError("trained")

    finished = regression._replace(step_fn=never, validate_fn=never)
    variables, _, done = train(finished, data, tmp_path)
    assert done
    assert bitwise(variables, expected)


def test_validation_counts_every_example_once(regression, data, framed, tmp_path):
    """Ten of them, in batches of four."""
    train(regression, data, tmp_path, max_steps=4)
    scores = [line["validation"] for line in lines(tmp_path) if "validation" in line]
    batch = framed(data.validation, range(10), data.framing(VALIDATION_COMPLETE))
    assert scores[0]["first"] == pytest.approx(batch.scale.mean(), rel=1e-6)


def test_a_loss_that_is_not_finite_ends_it(regression, data, tmp_path):
    def broken(state, batch):
        state, loss = regression.step_fn(state, batch)
        return state, jnp.where(state.step == 6, jnp.nan, loss)

    with pytest.raises(FloatingPointError, match=r"toy: loss .*nan"):
        train(regression._replace(step_fn=broken), data, tmp_path)
    # The state before it is there to go on from.
    assert int(latest(regression, tmp_path).step) == 4


def test_variables_that_are_not_numbers_end_it(regression, data, tmp_path):
    """The loss of a step was taken before it."""

    def broken(state, batch):
        state, loss = regression.step_fn(state, batch)
        bad = jax.tree.map(lambda x: x * jnp.nan, state.variables)
        return state._replace(variables=bad) if state.step == 8 else state, loss

    with pytest.raises(FloatingPointError, match=r"toy: variables .* step 8"):
        train(regression._replace(step_fn=broken), data, tmp_path)
    assert int(latest(regression, tmp_path).step) == 4


def test_a_phase_that_fills_no_batch_is_refused(regression, data, tmp_path):
    with pytest.raises(InputError, match="toy: 3 samples do not fill a batch of 4"):
        train(regression._replace(num_samples=3), data, tmp_path)


def test_ended_early_nothing_is_kept_that_an_unbroken_phase_would_not(data, tmp_path):
    """The best of all scores is of a step at which nothing is validated."""
    scores = np.full(STEPS + 1, 9.0)
    scores[[3, 8]] = 0.1, 0.2
    train(counting(scores), data, tmp_path, max_steps=3)
    assert not [line for line in lines(tmp_path) if "validation" in line]
    variables, *_ = train(counting(scores), data, tmp_path)
    assert np.array_equal(variables["params"]["w"], [8, 8, 8])
