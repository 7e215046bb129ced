"""A network to compare with, trained on Eq. 10."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.baselines.pcn import PCN, PCNConfig
from experiments.settings import resolve
from prism_jax.data.pipeline import Framing
from prism_jax.losses.primary import stage_chamfers
from prism_jax.training.config import PhaseConfig
from prism_jax.training.supervised import network_phase

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
    for _ in range(20):
        state, last = phase.step_fn(state, batch)
    assert last.sum() < 0.8 * first.sum()
    assert int(state.step) == 21
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


class Drawing(nn.Module):
    """Three points that move alike, with a loss of its own."""

    own_losses = ("drawn",)

    @nn.compact
    def __call__(self, partial, train=False):
        moved = self.param("moved", nn.initializers.ones, (3,))
        return (partial[..., :3, :] + moved,)

    def supervised(self, partial, complete, norm, train=True):
        assert train and norm == "l1" and partial.shape[0] == complete.shape[0]
        (stage,) = self(partial, train)
        drawn = jax.random.uniform(self.make_rng("noise"), (len(partial), 1))
        return (stage,), drawn + (stage - partial[..., :3, :]).mean((-2, -1))[:, None]


def test_a_loss_of_its_own_counts_and_draws_anew_each_step(batch):
    config = dataclasses.replace(resolve("tiny").pretrain, warmup_steps=0)
    short = PhaseConfig("drawing", 40, None, learning_rate=0.1)
    phase, again, other = (
        network_phase(Drawing(), 64, short, config, seed) for seed in (0, 0, 1)
    )
    assert phase.terms == ("drawn", "stage_0")
    assert phase.scores == ("stage_0", "log_cd_l1")
    state, first = phase.step_fn(phase.start, batch)
    _, same = again.step_fn(again.start, batch)
    _, seeded = other.step_fn(other.start, batch)
    np.testing.assert_array_equal(first, same)
    assert first[0] != seeded[0] and first[1] == seeded[1]
    assert 1 < first[0] < 2  # The move, and what is drawn.
    later = phase.start._replace(step=state.step)
    _, drawn = phase.step_fn(later, batch)
    assert drawn[0] != first[0] and drawn[1] == first[1]
    # Its gradient is there: Adam's first step goes down it and Eq. 10 together.
    far = batch._replace(complete=batch.complete + np.float32(100))
    near, _ = phase.step_fn(phase.start, batch)
    pulled, _ = phase.step_fn(phase.start, far)
    moves = [s.variables["params"]["moved"] for s in (near, pulled)]
    assert not np.array_equal(*moves)
