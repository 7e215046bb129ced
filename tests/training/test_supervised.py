"""A network to compare with, trained on Eq. 10."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.baselines.pcn import PCN, PCNConfig
from experiments.baselines.training import network_phase
from experiments.settings import resolve
from prism_jax.data.pipeline import Framing
from prism_jax.losses.primary import stage_chamfers
from prism_jax.training.config import PhaseConfig

BATCH = 4
MODULE = PCN(
    PCNConfig(64, (8, 16), (16, 32), (32,), num_coarse=32, fold_features=(16,))
)


@pytest.fixture(scope="module")
def phase():
    config = dataclasses.replace(
        resolve("tiny").pretrain, batch_size=BATCH, warmup_steps=2
    )
    phase = PhaseConfig("pcn", 40 * BATCH, None, learning_rate=3e-3)
    return network_phase(MODULE, 64, phase, config, seed=0)


@pytest.fixture(scope="module")
def batch(examples, framed):
    return framed(examples, range(BATCH), Framing(64, 128, 1.4))


def test_the_terms_are_eq_10_stage_by_stage(phase, batch):
    _, losses = phase.step_fn(phase.start, batch)
    stages = jax.jit(MODULE.apply)(phase.start.variables, jnp.asarray(batch.partial))
    complete = jnp.asarray(batch.complete)
    each = jax.jit(jax.vmap(lambda s, c: stage_chamfers(s, c, "l1")))(stages, complete)
    np.testing.assert_allclose(losses, each.mean(0), rtol=1e-5)
    assert phase.terms == ("stage_0", "stage_1")
    assert phase.scores == ("stage_0", "stage_1", "log_cd_l1")


def test_it_learns_and_only_parameters_change(phase, batch):
    state, first = phase.step_fn(phase.start, batch)
    for _ in range(8):
        state, last = phase.step_fn(state, batch)
    assert last.sum() < first.sum()
    assert int(state.step) == 9
    assert state.variables["batch_stats"] == {}


def test_the_score_is_in_the_unit_of_the_scores(phase, batch):
    scores = np.asarray(phase.validate_fn(phase.start.variables, batch))
    doubled = batch._replace(scale=2 * batch.scale)
    twice = np.asarray(phase.validate_fn(phase.start.variables, doubled))
    assert scores.shape == (BATCH, 3)
    np.testing.assert_allclose(twice[:, :2], 4 * scores[:, :2], rtol=1e-6)
    np.testing.assert_allclose(twice[:, 2], scores[:, 2] + np.log(2), atol=1e-6)


def test_a_seed_is_one_start(phase):
    training, short = resolve("tiny").pretrain, PhaseConfig("pcn", 64, None)
    same = network_phase(MODULE, 64, short, training, seed=0).start.variables
    other = network_phase(MODULE, 64, short, training, seed=1).start.variables
    first = jax.tree.leaves(phase.start.variables)
    pairs = zip(first, jax.tree.leaves(same), strict=True)
    assert all(np.array_equal(a, b) for a, b in pairs)
    pairs = zip(first, jax.tree.leaves(other), strict=True)
    assert any(not np.array_equal(a, b) for a, b in pairs)
