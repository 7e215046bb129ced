"""The backbone's phases, on boxes, and the optimiser of all that is trained."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial import cKDTree

from prism_jax.evaluation.metrics import score, unseen_scores
from prism_jax.training.optimisers import MUON_RMS, optimiser
from prism_jax.training.supervised import backbone_phase, supervised_phase
from tests.trees import assert_close, bitwise

BATCH = 4


@pytest.fixture(scope="module")
def phase_of(minimal, minimal_variables):
    """``phase_of(blocks)``: trains so many blocks of the decoder."""
    names, kinds = ("point_encoder", "decoder"), ("params", "batch_stats")
    backbone = {
        kind: {name: minimal_variables[kind][name] for name in names} for kind in kinds
    }

    def make(num_blocks):
        samples = {"num_samples": 60 * BATCH, "learning_rate": 3e-3}
        phase = dataclasses.replace(
            minimal.pretrain.backbone[0], num_blocks=num_blocks, **samples
        )
        training = dataclasses.replace(
            minimal.pretrain, batch_size=BATCH, average_decay=0.15
        )
        return backbone_phase(backbone, minimal.model.backbone, phase, training)

    return make


@pytest.fixture(scope="module")
def stages(phase_of):
    return phase_of(None)


def test_the_phase_of_the_seeds_has_their_loss_alone(phase_of, batch):
    phase = phase_of(0)
    _, losses = jax.eval_shape(phase.step_fn, phase.start, batch)
    assert losses.shape == (1,) and phase.terms == ("seeds",)


def test_the_whole_decoder_trains(stages, batch):
    """The first step has no size, and moves statistics alone. The average that is kept
    forgets sooner at first."""
    states = [stages.start]
    for _ in range(3):
        state, losses = stages.step_fn(states[-1], batch)
        states.append(state)
        assert losses.shape == (2,)
    before, first, *_, last = (state.variables for state in states)
    assert bitwise(first["params"], before["params"])
    assert not bitwise(first["batch_stats"], before["batch_stats"])
    for kind in ("params", "batch_stats"):
        assert not bitwise(before[kind]["point_encoder"], last[kind]["point_encoder"])
        for name, tree in before[kind]["decoder"].items():
            assert not bitwise(tree, last[kind]["decoder"][name]), name
    expected = before
    for state, kept in zip(states[1:], [0.1, 0.15, 0.15], strict=True):
        expected = jax.tree.map(
            lambda old, new, kept=kept: kept * old + (1 - kept) * new,
            expected,
            state.variables,
        )
    assert_close(states[3].kept, expected, 1e-5)
    assert stages.step_fn._cache_size() == 1


def test_validation_is_in_the_unit_of_the_scores(stages, batch, minimal):
    """CD-L2 of each stage, and the logarithm of CD-L1, of points that are known; those
    of the network are traced alone."""
    variables = stages.start.variables
    assert jax.eval_shape(stages.validate_fn, variables, batch).shape == (BATCH, 4)

    def made(variables, batch):
        partial = jnp.asarray(batch.partial)
        return partial[:, :9], 1.02 * jnp.asarray(batch.complete)[:, ::3]

    sizes = minimal.pretrain.backbone[0], minimal.pretrain
    phase = supervised_phase({"params": {}}, made, made, ("a", "b"), *sizes)
    found = phase.validate_fn({}, batch)
    for row, partial, complete, scale in zip(
        found, *batch[:2], batch.scale, strict=True
    ):
        made = 1.02 * np.asarray(complete)[::3]
        first, last = score(partial[:9], complete), score(made, complete)
        squared = first.cd_l2 * scale**2, last.cd_l2 * scale**2
        side = float(np.ptp(complete, axis=0).max())
        read, truth = cKDTree(partial), cKDTree(complete)
        new = made[read.query(made)[0] > 0.02 * side]
        hidden = complete[read.query(complete)[0] > 0.02 * side]
        apart = truth.query(new)[0], cKDTree(made).query(hidden)[0]
        f_2 = unseen_scores(*apart, side)["f_2"]
        assert 0.1 < f_2 < 0.9
        expected = *squared, f_2, np.log(last.cd_l1 * scale)
        np.testing.assert_allclose(row, expected, rtol=1e-4, atol=1e-5)


def moves(adam, count):
    """Adam under a constant gradient moves by the step size itself."""
    state, found = adam.init(jnp.zeros(())), []
    update = jax.jit(adam.update)
    for _ in range(count):
        updates, state = update(jnp.float32(0.5), state)
        found.append(-float(updates))
    return found


def test_step_sizes_rise_and_then_follow_a_cosine():
    """A phase shorter than the warm-up gets half of it."""
    expected = [0.1 * i / 5 for i in range(5)]
    for i in range(36):
        cosine = 0.5 * (1 + np.cos(np.pi * i / 35))
        expected.append(0.1 * (0.2 + 0.8 * cosine))
    found = moves(optimiser("adam", 0.1, 40, 0.2, warmup_steps=5, clip_norm=10.0), 41)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-7)
    found = moves(optimiser("adam", 0.1, 8, 1.0, warmup_steps=200, clip_norm=1.0), 5)
    np.testing.assert_allclose(found, [0, 0.025, 0.05, 0.075, 0.1], rtol=1e-3)


def test_muon_turns_a_matrix_alone_and_leaves_the_rest_to_adam():
    """Its singular vectors stay, and all its singular values become about one."""
    gradient = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    params = {"kernel": jnp.zeros((6, 4)), "bias": jnp.zeros(4)}
    muon = optimiser("muon", 0.1, 8, 1.0, warmup_steps=0, clip_norm=0.0)
    grads = {"kernel": jnp.asarray(gradient), "bias": jnp.asarray([1.0, -2, 3, 0])}
    updates, _ = jax.jit(muon.update)(grads, muon.init(params), params)
    adam = optax.nadam(0.1)
    expected, _ = adam.update(grads["bias"], adam.init(params["bias"]))
    np.testing.assert_allclose(updates["bias"], expected, rtol=1e-5)
    left, _, right = np.linalg.svd(gradient, full_matrices=False)
    found = left.T @ -np.asarray(updates["kernel"]) @ right.T
    found /= 0.1 * MUON_RMS * np.sqrt(6)
    assert np.abs(np.diag(found) - 1).max() < 0.35
    np.testing.assert_allclose(found - np.diag(np.diag(found)), 0, atol=1e-3)
