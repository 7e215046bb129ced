"""The backbone's phases, on boxes."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from experiments.indices import index_table
from prism_jax.data.holdout import Subset
from prism_jax.data.pipeline import Framing, training_batches
from prism_jax.training import parallel
from prism_jax.training.backbone import backbone_phase
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.optimisers import optimiser
from prism_jax.training.phase import VALIDATION_COMPLETE, Data, order_seed, train_phase
from tests.trees import bitwise

BATCH, FRAMING = 4, Framing(64, 128, 1.4)


@pytest.fixture(scope="module")
def preset(minimal):
    """Two short phases, the second with longer steps."""
    seeds, stages = minimal.pretrain.backbone
    phases = (
        dataclasses.replace(seeds, num_samples=8 * BATCH),
        dataclasses.replace(stages, num_samples=60 * BATCH, learning_rate=3e-3),
    )
    training = dataclasses.replace(
        minimal.pretrain, backbone=phases, batch_size=BATCH, validate_every=4 * BATCH
    )
    return dataclasses.replace(minimal, pretrain=training)


@pytest.fixture(scope="module")
def backbone(minimal_variables):
    """The backbone's part of the variables."""
    return parts_of(minimal_variables, "point_encoder", "decoder")


def parts_of(variables, *names):
    return {
        kind: {name: variables[kind][name] for name in names}
        for kind in ("params", "batch_stats")
    }


@pytest.fixture(scope="module")
def seeds(preset, backbone):
    phase = preset.pretrain.backbone[0]
    return backbone_phase(backbone, preset.model.backbone, phase, preset.pretrain)


@pytest.fixture(scope="module")
def stages(preset, backbone):
    phase = preset.pretrain.backbone[1]
    return backbone_phase(backbone, preset.model.backbone, phase, preset.pretrain)


@pytest.fixture(scope="module")
def data(examples, validation_examples):
    """Six examples to validate on, in batches of four."""
    validation = Subset(validation_examples, np.arange(6))
    return Data(examples, validation, 64, FRAMING.margin, 0, 4 * BATCH)


@pytest.fixture(scope="module")
def batch(examples, framed):
    return framed(examples, range(BATCH), FRAMING)


@pytest.fixture(scope="module")
def indexed(batch, examples, preset):
    """With what the encoder looks up, made beforehand."""
    table = index_table(examples, FRAMING, preset.model.backbone)
    return batch._replace(indices=jax.tree.map(lambda leaf: leaf[:BATCH], table))


@pytest.fixture(scope="module")
def after_seeds(seeds, batch):
    state = seeds.start
    for _ in range(2):
        state, losses = seeds.step_fn(state, batch)
    return state, losses


@pytest.mark.slow
def test_losses_fall_on_one_batch(stages, indexed):
    """Every stage's, over a phase of sixty steps."""
    state, history = stages.start, []
    for _ in range(60):
        state, losses = stages.step_fn(state, indexed)
        history.append(np.asarray(losses))
    assert history[0].shape == (2,)
    first, last = np.mean(history[:5], axis=0), np.mean(history[-5:], axis=0)
    assert (last < 0.8 * first).all(), (first, last)
    assert int(state.step) == 60


def test_the_phase_of_the_seeds_leaves_the_later_stages_alone(seeds, after_seeds):
    state, losses = after_seeds
    assert losses.shape == (1,)
    for kind in ("params", "batch_stats"):
        before, after = seeds.start.variables[kind], state.variables[kind]
        assert not bitwise(before["point_encoder"], after["point_encoder"])
        for name in before["decoder"]:
            same = bitwise(before["decoder"][name], after["decoder"][name])
            assert same == name.startswith("block"), name


def test_the_whole_decoder_trains(stages, indexed):
    """From the second step on: the step size rises from zero."""
    state = stages.start
    for _ in range(2):
        state, _ = stages.step_fn(state, indexed)
    before, after = stages.start.variables, state.variables
    for kind in ("params", "batch_stats"):
        for name, tree in before[kind]["decoder"].items():
            assert not bitwise(tree, after[kind]["decoder"][name]), name


def test_indices_that_come_with_a_batch_are_those_that_are_used(stages, indexed):
    _, expected = stages.step_fn(stages.start, indexed)
    others = jax.tree.map(lambda leaf: leaf[::-1].copy(), indexed.indices)
    _, losses = stages.step_fn(stages.start, indexed._replace(indices=others))
    assert not np.allclose(losses, expected, rtol=1e-4)
    assert stages.step_fn._cache_size() == 1


def test_the_first_step_is_of_size_zero_and_moves_statistics_alone(seeds, batch):
    state, _ = seeds.step_fn(seeds.start, batch)
    assert bitwise(state.variables["params"], seeds.start.variables["params"])
    before = seeds.start.variables["batch_stats"]["point_encoder"]
    assert not bitwise(state.variables["batch_stats"]["point_encoder"], before)


@pytest.mark.slow
def test_broken_off_and_resumed_it_ends_as_if_it_had_not(seeds, data, tmp_path):
    """Bitwise; and every step, before a checkpoint and after, is of one compilation."""
    mesh = parallel.data_mesh()
    expected = [parallel.replicate(seeds.start, mesh)]
    seed = order_seed(data.seed, seeds.name)
    batches = training_batches(data.train, FRAMING, BATCH, seed)
    for _ in range(8):
        batch = parallel.share(next(batches), mesh)
        expected.append(seeds.step_fn(expected[-1], batch)[0])
    compiled = seeds.step_fn._cache_size()
    *_, done = train_phase(seeds, data, tmp_path, max_steps=4)
    assert not done
    best, _, done = train_phase(seeds, data, tmp_path)
    assert done
    checkpoints = Checkpoints(tmp_path / seeds.name)
    assert bitwise(checkpoints.restore_latest(seeds.start), expected[8])
    checkpoints.close()
    text = (tmp_path / "metrics.jsonl").read_text()
    written = [json.loads(line) for line in text.splitlines()]
    written = [line["validation"] for line in written if "validation" in line]
    scores = [line["log_cd_l1"] for line in written]
    assert len(scores) == 2
    assert bitwise(best, expected[4 if scores[0] <= scores[1] else 8].variables)
    assert seeds.step_fn._cache_size() == compiled
    assert seeds.validate_fn._cache_size() == 1


@pytest.mark.slow
def test_the_average_is_what_is_kept(preset, backbone, batch):
    """In closed form: it forgets sooner at first. Training is as without it."""
    phase, settings = preset.pretrain.backbone[0], preset.pretrain
    averaged = dataclasses.replace(settings, average_decay=0.25)
    with_average = backbone_phase(backbone, preset.model.backbone, phase, averaged)
    alone = backbone_phase(backbone, preset.model.backbone, phase, settings)
    assert alone.start.average is None
    state, plain, expected = with_average.start, alone.start, alone.start.variables
    assert bitwise(state.kept, state.variables)
    for step, kept in enumerate([0.1, 2 / 11, 0.25, 0.25]):
        state, _ = with_average.step_fn(state, batch)
        plain, _ = alone.step_fn(plain, batch)
        assert bitwise(state.variables, plain.variables), step
        expected = jax.tree.map(
            lambda old, new, kept=kept: kept * old + (1 - kept) * new,
            expected,
            state.variables,
        )
    for a, b in zip(*map(jax.tree.leaves, (state.kept, expected)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_validation_is_in_the_unit_of_the_scores(seeds, examples, framed):
    variables = seeds.start.variables
    framing = dataclasses.replace(FRAMING, num_complete=VALIDATION_COMPLETE)
    batch = framed(examples, range(BATCH), framing)
    scores = np.asarray(seeds.validate_fn(variables, batch))
    assert scores.shape == (BATCH, 2)
    squared, log_plain = scores.T
    assert (squared > 0).all()
    # By Jensen's inequality; CD-L2 is the sum of both directions, CD-L1 their mean.
    assert (np.exp(log_plain) <= np.sqrt(squared)).all()
    doubled = batch._replace(scale=2 * batch.scale)
    twice = np.asarray(seeds.validate_fn(variables, doubled))
    np.testing.assert_allclose(twice[:, 0], 4 * squared, rtol=1e-6)
    np.testing.assert_allclose(twice[:, 1], log_plain + np.log(2), atol=1e-6)


def test_step_sizes_rise_and_then_follow_a_cosine():
    """Adam under a constant gradient moves by the step size itself."""
    adam = optimiser("adam", 0.1, 40, 0.2, warmup_steps=5, clip_norm=10.0)
    params = jnp.zeros(())
    state, moves = adam.init(params), []
    for _ in range(41):
        updates, state = adam.update(jnp.float32(0.5), state)
        moves.append(-float(updates))
    expected = [0.1 * i / 5 for i in range(5)]
    for i in range(36):
        cosine = 0.5 * (1 + np.cos(np.pi * i / 35))
        expected.append(0.1 * (0.2 + 0.8 * cosine))
    np.testing.assert_allclose(moves, expected, rtol=1e-3, atol=1e-7)


def test_a_phase_shorter_than_the_warm_up_gets_half_of_it(preset):
    settings = preset.pretrain
    adam = optimiser("adam", 0.1, 8, 1.0, settings.warmup_steps, settings.clip_norm)
    state, moves = adam.init(jnp.zeros(())), []
    for _ in range(8):
        updates, state = adam.update(jnp.float32(0.5), state)
        moves.append(-float(updates))
    np.testing.assert_allclose(moves[:5], [0, 0.025, 0.05, 0.075, 0.1], rtol=1e-3)


def test_gradients_are_clipped_together(preset):
    """One enormous gradient does not outweigh the moments of all that follow."""
    config = dataclasses.replace(preset.pretrain, clip_norm=1.0, warmup_steps=0)
    adam = optimiser("adam", 0.1, 1000, 1.0, config.warmup_steps, config.clip_norm)
    params = {"a": jnp.zeros(2), "b": jnp.zeros(())}
    state = adam.init(params)
    huge = {"a": jnp.array([3e9, 0.0]), "b": jnp.float32(-4e9)}
    _, state = adam.update(huge, state)
    mu = optax.tree_utils.tree_get(state, "mu")
    np.testing.assert_allclose(mu["a"], [0.1 * 0.6, 0], rtol=1e-5)
    np.testing.assert_allclose(mu["b"], 0.1 * -0.8, rtol=1e-5)
