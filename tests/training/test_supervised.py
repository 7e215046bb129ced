"""A network to compare with, trained on Eq. 10."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baselines.pcn import PCN, PCNConfig
from experiments.baselines.training import network_phase
from experiments.settings import resolve
from prism_jax.data.pipeline import Framing
from prism_jax.losses.chamfer import stage_chamfers
from prism_jax.training.config import PhaseConfig
from tests.trees import equal

BATCH = 4
MODULE = PCN(
    PCNConfig(64, (8, 16), (16, 32), (32,), num_coarse=32, fold_features=(16,))
)


def test_it_learns_from_eq_10_stage_by_stage(examples, framed):
    training = dataclasses.replace(
        resolve("tiny").pretrain, batch_size=BATCH, warmup_steps=2
    )
    settings = PhaseConfig("pcn", 40 * BATCH, None, learning_rate=3e-3)
    phase, other = (
        network_phase(MODULE, 64, settings, training, seed) for seed in (0, 1)
    )
    assert not equal(phase.start.variables, other.start.variables)
    batch = framed(examples, range(BATCH), Framing(64, 128, 1.4))
    state, first = phase.step_fn(phase.start, batch)
    stages = jax.jit(MODULE.apply)(phase.start.variables, jnp.asarray(batch.partial))
    complete = jnp.asarray(batch.complete)
    each = jax.jit(jax.vmap(lambda s, c: stage_chamfers(s, c, "l1")))(stages, complete)
    np.testing.assert_allclose(first, each.mean(0), rtol=1e-5)
    assert phase.scores == ("stage_0", "stage_1", "f_2", "log_cd_l1")
    for _ in range(8):
        state, last = phase.step_fn(state, batch)
    assert last.sum() < first.sum()
    assert state.variables["batch_stats"] == {}
