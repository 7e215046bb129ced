"""The training loop, around phases so small that they compile to nothing."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.data.pipeline import training_batches
from prism_jax.training import phase as training_phase
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.phase import VALIDATION_COMPLETE, Data, order_seed
from prism_jax.training.phase import train_phase as train
from prism_jax.training.run import Log
from tests.training.conftest import Boxes, lines, regression_phase
from tests.trees import bitwise

BATCH, STEPS, MARGIN = 4, 12, 1.4


@pytest.fixture(scope="module")
def data(examples, validation_examples):
    """Validation comes every fourth step."""
    every = 4 * BATCH
    parts = {"boxes": validation_examples}
    return Data(examples, parts, 64, MARGIN, 7, validate_every=every)


@pytest.fixture(scope="module")
def regression():
    return regression_phase(BATCH, STEPS, 0.05)


def counting(scores):
    """A phase whose only parameter is the step number, and whose score is a table's."""
    loss = jax.device_put(np.ones(1))

    def step(state, batch):
        w = np.asarray(state.variables["params"]["w"]) + 1
        variables = {"params": {"w": jax.device_put(w)}}
        return state._replace(step=state.step + 1, variables=variables), loss

    def validate(variables, batch):
        step = int(variables["params"]["w"][0])
        return np.full((len(batch.eye), 1), scores.get(step, 9.0))

    phase = regression_phase(BATCH, STEPS, 0.05)
    return phase._replace(step_fn=step, validate_fn=validate, scores=("score",))


def latest(phase, folder):
    with contextlib.closing(Checkpoints(folder / phase.name)) as checkpoints:
        return checkpoints.restore(phase.start)


def recording(phase, seen):
    """The phase, noting which batch each step is given."""

    def step(state, batch):
        seen.append((int(state.step), batch))
        return phase.step_fn(state, batch)

    return phase._replace(step_fn=step)


@pytest.fixture(scope="module")
def unbroken(regression, data, tmp_path_factory):
    """A training to its end: its folder, the batches of its steps, what it left."""
    folder, seen = tmp_path_factory.mktemp("unbroken"), []
    return folder, seen, train(recording(regression, seen), data, folder)


def test_it_learns_and_logs(regression, data, framed, unbroken):
    folder, _, (variables, last, done) = unbroken
    assert done
    found = lines(folder)
    losses = [line["losses"]["loss"] for line in found if "losses" in line]
    assert losses[-1] < losses[0]
    assert [line["step"] for line in found if "validation" in line] == [4, 8, 12]
    assert [line["samples"] for line in found if "losses" in line] == [16, 32, 48]
    assert {line["phase"] for line in found} == {"toy"}
    assert bitwise(last, latest(regression, folder))
    assert bitwise(variables, last.variables)
    # Ten examples, in batches of four, each of them once.
    scores = next(line["validation"] for line in found if "validation" in line)
    framing = data.framing(VALIDATION_COMPLETE)
    batch = framed(data.validation["boxes"], range(10), framing)
    assert scores["boxes/scale"] == pytest.approx(batch.scale.mean(), rel=1e-6)


def test_the_batches_are_those_of_the_pipeline(data, unbroken):
    """From the first on, over more than one epoch."""
    seed = order_seed(data.seed, "toy")
    batches = training_batches(data.train, data.framing(128), BATCH, seed)
    seen = [batch for _, batch in unbroken[1]]
    assert len(seen) == STEPS
    for batch in seen:
        assert bitwise(batch, next(batches))


def test_broken_off_and_resumed_it_ends_the_same(regression, data, unbroken, tmp_path):
    """Moments and step count of the optimiser too. A finished phase is not trained
    again, and every step has the state of one compilation."""
    for steps in (3, 8):
        assert not train(regression, data, tmp_path, max_steps=steps).done
        assert int(latest(regression, tmp_path).step) == steps
    assert bitwise(train(regression, data, tmp_path), unbroken[2])

    def never(*arguments):
        raise AssertionError("trained")

    finished = regression._replace(step_fn=never, validate_fn=never)
    assert bitwise(train(finished, data, tmp_path), unbroken[2])
    assert regression.step_fn._cache_size() == 1
    assert regression.validate_fn._cache_size() == 1


@pytest.mark.parametrize(("seconds", "kept"), [(120.0, 4), (-1.0, 6)])
def test_killed_between_checkpoints_it_repeats_what_was_lost(
    regression, data, unbroken, tmp_path, monkeypatch, seconds, kept
):
    """The last save is that of the validation, or of a log line when it is due."""
    seen = []
    remembering = recording(regression, seen)

    def dying(state, batch):
        if len(seen) == 7:
            raise KeyboardInterrupt
        return remembering.step_fn(state, batch)

    monkeypatch.setattr(training_phase, "LOG_EVERY", 3)
    monkeypatch.setattr(training_phase, "SAVE_SECONDS", seconds)
    with pytest.raises(KeyboardInterrupt):
        train(regression._replace(step_fn=dying), data, tmp_path)
    assert int(latest(regression, tmp_path).step) == kept
    assert bitwise(train(remembering, data, tmp_path), unbroken[2])
    assert [step for step, _ in seen] == [*range(7), *range(kept, STEPS)]
    for step, batch in seen:
        assert bitwise(batch, unbroken[1][step][1])


def test_one_step_is_queued_and_no_more(data, tmp_path, monkeypatch):
    """When the bar moves, all steps but the last are done."""
    waited, done = [], []

    def step(state, batch):
        loss = jax.device_put(np.full(1, len(waited)))
        return state._replace(step=state.step + 1), loss

    def advance(log, samples):
        done.append(None if waited[-1] is None else int(waited[-1][0]))

    monkeypatch.setattr(jax, "block_until_ready", waited.append)
    monkeypatch.setattr(Log, "advance", advance)
    train(counting({})._replace(step_fn=step), data, tmp_path, max_steps=4)
    assert done == [None, 0, 1, 2]


def test_phases_are_told_apart_by_seed_and_name():
    seeds = [order_seed(seed, name) for name in ("seeds", "meta") for seed in (0, 1)]
    assert len(set(seeds)) == 4 and min(seeds) >= 0 and max(seeds) < 2**31


def test_what_did_best_on_validation_is_kept(data, tmp_path):
    """And is a number. It does not validate where it is broken off."""
    phase = counting({3: 0.1, 4: np.nan, 8: 0.2, 12: 0.4})
    train(phase, data, tmp_path, max_steps=3)
    assert not [line for line in lines(tmp_path) if "validation" in line]
    variables, last, _ = train(phase, data, tmp_path)
    assert np.array_equal(variables["params"]["w"], [8, 8, 8])
    assert int(last.step) == STEPS


def test_it_ends_when_it_gains_nothing_more(data, tmp_path):
    """At step 8, which is no better than step 4; being broken off is no validation."""
    phase = counting({4: 0.1, 8: 0.2})._replace(patience=3 * BATCH)
    assert not train(phase, data, tmp_path, max_steps=7).done
    for _ in range(2):
        variables, last, done = train(phase, data, tmp_path)
        assert done and int(last.step) == 8
        assert np.array_equal(variables["params"]["w"], [4, 4, 4])


def test_sets_count_alike_however_large(data, tmp_path):
    """Better on the small set by more than worse on the large one."""
    few = {"few": Boxes(1, 0), "many": data.validation["boxes"]}

    def validate(variables, batch):
        at, few = variables["params"]["w"][0], batch.scale[0] == batch.scale[1]
        return np.full((BATCH, 1), (9 - at if few else at / 2))

    phase = counting({})._replace(validate_fn=validate)
    variables, _, _ = train(phase, data._replace(validation=few), tmp_path)
    assert np.array_equal(variables["params"]["w"], [12, 12, 12])


@pytest.mark.parametrize(
    ("step", "what", "fault"),
    [(6, "loss", r"toy: loss .*nan"), (8, "variables", r"toy: variables .* step 8")],
)
def test_what_is_not_finite_ends_it(regression, data, tmp_path, step, what, fault):
    """The loss of a step was taken before it."""

    def broken(state, batch):
        state, loss = regression.step_fn(state, batch)
        if int(state.step) != step:
            return state, loss
        if what == "loss":
            return state, loss * jnp.nan
        bad = jax.tree.map(lambda x: x * jnp.nan, state.variables)
        return state._replace(variables=bad), loss

    with pytest.raises(FloatingPointError, match=fault):
        train(regression._replace(step_fn=broken), data, tmp_path)
    assert int(latest(regression, tmp_path).step) == 4
