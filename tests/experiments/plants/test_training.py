"""The label-free training, with a network that is quick to compile."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from experiments.plants import training
from experiments.plants.frames import Unlabelled, read_frames
from experiments.plants.training import (
    MOVED,
    TERMS,
    PlantConfig,
    _orders,
    _way,
    adapt,
    frame_losses,
    make_step,
    put,
    student_batch,
    told_nothing,
)
from prism_jax.geometry.workspace import Workspace
from prism_jax.losses.primary import primary_loss
from prism_jax.models.prism import predict, prepare_input
from prism_jax.observation.observation import observe
from tests.trees import bitwise, equal

SETTINGS = PlantConfig(
    batch_size=2,
    warmup_steps=0,
    learning_rate=1e-3,
    num_label=96,
    num_hidden=32,
    auxiliary_weight=0.0,
)


@pytest.fixture(scope="module")
def config(minimal):
    return told_nothing(minimal.config)


@pytest.fixture(scope="module")
def batch(boxes, config):
    frames = read_frames(Unlabelled(boxes()), config)[:2]
    rng = np.random.default_rng(0)
    predictions = rng.uniform(-0.5, 0.5, (2, 64, 3))
    return student_batch(frames, predictions, config, SETTINGS, rng)


@pytest.fixture(scope="module")
def adapted(boxes, config, minimal_fresh):
    def run(truth=np.nan, steps=2, minutes=None, seed=0):
        source = Unlabelled(boxes(truth))
        return adapt(config, minimal_fresh, source, SETTINGS, seed, steps, minutes)

    return run


@pytest.fixture(scope="module")
def twice(adapted):
    return adapted()


@pytest.mark.slow
def test_a_step_lowers_its_loss_and_moves_what_is_to_move(batch, config, minimal_fresh):
    step, state = make_step(config, minimal_fresh, SETTINGS)
    key = jax.random.key(0)
    state, before = step(minimal_fresh, state, batch, key)
    for _ in range(3):
        state, after = step(minimal_fresh, state, batch, key)
    assert after[-1] < before[-1]
    weights = np.array([0.5, 0.5, 0.25, 0.0])
    np.testing.assert_allclose(before[-1], weights @ before[:-1], rtol=1e-5)
    assert len(before) == len(TERMS)
    assert set(state.variables) == set(MOVED["everything"])
    assert not equal(state.variables["decoder"], state.kept["decoder"])


@pytest.mark.parametrize("moves", ["encoders", "decoder"])
def test_the_choice_of_parts_is_kept(moves, config, minimal_fresh):
    settings = dataclasses.replace(SETTINGS, moves=moves)
    _, state = make_step(config, minimal_fresh, settings)
    assert set(state.variables) == set(MOVED[moves])
    whole = put(minimal_fresh, jax.tree.map(jnp.zeros_like, state.variables))
    for name in minimal_fresh["params"]:
        same = equal(whole["params"][name], minimal_fresh["params"][name])
        assert same == (name not in MOVED[moves])


def test_the_terms_are_eq_10_and_what_was_hidden(batch, config, minimal_fresh):
    """Both ways at half weight are Eq. 10 of the pseudo-label."""
    partial, eye, wanted = (
        jnp.asarray(each[0]) for each in (batch.partial, batch.eye, batch.complete)
    )
    key = jax.random.key(0)

    @jax.jit
    def both(partial, eye, wanted):
        arrays = (partial, eye, wanted, key)
        terms = frame_losses(minimal_fresh, *arrays, config, 96, False)
        camera = observe(partial, eye, Workspace.unit()).camera
        inputs = prepare_input(partial, camera, key, config.model)
        return terms, predict(minimal_fresh, inputs, config.model)

    (cover, toward, hidden, auxiliary), prediction = both(partial, eye, wanted)
    stages = (*prediction.stages[:-1], prediction.points)
    expected = primary_loss(stages, wanted[:96], "l1")
    np.testing.assert_allclose(0.5 * (cover + toward), expected, rtol=1e-5)
    gaps = np.linalg.norm(wanted[96:, None] - prediction.points[None], axis=-1)
    np.testing.assert_allclose(hidden, gaps.min(1).mean(), rtol=1e-5)
    assert auxiliary == 0


def test_a_way_has_its_gradient_and_none_where_points_meet(x64):
    rng = np.random.default_rng(0)
    start, end = rng.uniform(-1, 1, (7, 3)), rng.uniform(-1, 1, (9, 3))

    def way(*clouds):
        return _way(*map(jnp.asarray, clouds))

    check_grads(way, (start, end), 1, ("rev",), eps=1e-6)
    slopes = jax.grad(way)(start, start)
    np.testing.assert_array_equal(slopes, 0.0)


def test_what_eq_13_judges_joins(batch, config, minimal_fresh, monkeypatch):
    """The objective's prediction is the one that is trained, and its value a term."""

    def objective(variables, inputs, config):
        prediction = predict(variables, inputs, config.model)
        moved = prediction._replace(points=prediction.points + 9.0)
        return SimpleNamespace(objective=jnp.float32(3.0)), moved

    monkeypatch.setattr(training, "test_time_objective", objective)
    arrays = (batch.partial[0], batch.eye[0], batch.complete[0])
    arrays = (*map(jnp.asarray, arrays), jax.random.key(0))
    terms = jax.jit(lambda *each: frame_losses(minimal_fresh, *each, config, 96))
    _, _, hidden, auxiliary = terms(*arrays)
    assert auxiliary == 3.0 and hidden > 9.0


def test_no_truth_is_looked_at_and_the_bytes_are_the_same(adapted, twice):
    """It is not a number in one, and zero in the other."""
    assert twice.steps == 2
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(twice.variables["params"]))
    zero = adapted(truth=0.0)
    assert bitwise(zero.variables, twice.variables)
    np.testing.assert_array_equal(zero.after.hidden, twice.after.hidden)


def test_every_frame_comes_once_before_any_comes_again():
    rows = [next(orders) for orders in [_orders(7, 3, 0)] for _ in range(7)]
    again = [next(orders) for orders in [_orders(7, 3, 0)] for _ in range(7)]
    np.testing.assert_array_equal(rows, again)
    assert np.bincount(np.concatenate(rows)).tolist() == [3] * 7
    assert sorted(np.concatenate(rows)[:7]) == list(range(7))
    assert not np.array_equal(next(_orders(7, 7, 1)), next(_orders(7, 7, 0)))
    # A batch may be larger than all there is.
    assert len(next(_orders(2, 5, 0))) == 5


def test_no_minutes_leave_all_as_it_was(adapted, minimal_fresh, twice):
    none = adapted(steps=None, minutes=0.0)
    assert none.steps == 0
    assert equal(none.variables, minimal_fresh)
    np.testing.assert_array_equal(none.before.hidden, none.after.hidden)
    np.testing.assert_array_equal(none.before.hidden, twice.before.hidden)
    with pytest.raises(ValueError, match="how many"):
        adapted(steps=None)


def test_settings_that_make_no_sense_are_refused():
    for change in ({"batch_size": 0}, {"moves": "heads"}, {"hidden_weight": -1.0}):
        with pytest.raises(ValueError, match=next(iter(change))):
            PlantConfig(**change)
