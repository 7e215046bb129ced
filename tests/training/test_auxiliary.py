"""The phase after the backbone's: what it trains, and on what."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.data.pipeline import Framing
from prism_jax.training.auxiliary import TRAINED, auxiliary_phase
from prism_jax.training.checkpoints import Checkpoints
from tests.trees import bitwise


@pytest.fixture(scope="module")
def phase(minimal, minimal_variables):
    training = dataclasses.replace(
        minimal.pretrain, auxiliary_samples=160, auxiliary_rate=0.01, batch_size=4
    )
    return auxiliary_phase(minimal_variables, minimal.config, training, seed=0)


@pytest.fixture(scope="module")
def batch(examples, framed):
    return framed(examples, range(4), Framing(64, 128, 1.4))


def steps(phase, batch, count, variables=None):
    state, history = phase.start, []
    if variables is not None:
        state = state._replace(variables=variables)
    for _ in range(count):
        state, terms = phase.step_fn(state, batch)
        history.append(np.asarray(terms))
    return state, np.array(history)


@pytest.fixture(scope="module")
def trained(phase, batch):
    return steps(phase, batch, 3)


def test_it_trains_these_and_nothing_of_the_backbone(phase, trained):
    before, after = phase.start.variables, trained[0].variables
    assert set(before["params"]) == {*TRAINED, "point_encoder", "decoder"}
    for name in before["params"]:
        same = bitwise(before["params"][name], after["params"][name])
        assert same == (name not in TRAINED), name
    for name in before["batch_stats"]:
        same = bitwise(before["batch_stats"][name], after["batch_stats"][name])
        assert same == (name != "depth_encoder"), name
    for name in before["params"]["auxiliary"]:
        branch = before["params"]["auxiliary"][name]
        assert not bitwise(branch, after["params"]["auxiliary"][name]), name


def test_loss_weights_stay_and_scales_are_measured(phase, trained):
    before, after = (
        phase.start.variables["weighting"],
        trained[0].variables["weighting"],
    )
    assert bitwise(before["logits"], after["logits"])
    assert (np.asarray(before["scales"]) == 0).all()
    assert (np.asarray(after["scales"]) > 0).all()


def test_scales_are_moving_averages_of_the_losses(phase, batch):
    """Of normals and denoising; the alignment is measured frame by frame."""
    first, _ = steps(phase, batch, 1)
    second, history = steps(phase, batch, 2)
    one = np.asarray(first.variables["weighting"]["scales"])
    two = np.asarray(second.variables["weighting"]["scales"])
    np.testing.assert_allclose(one[:2], history[0, 1:3], rtol=1e-5)
    expected = 0.99 * history[0, 1:3] + 0.01 * history[1, 1:3]
    np.testing.assert_allclose(two[:2], expected, rtol=1e-5)


@pytest.mark.slow
def test_losses_fall_on_one_batch(phase, batch):
    """But the denoiser's, whose noise is another at every step: it starts that low."""
    _, history = steps(phase, batch, 40)
    first, last = history[:5].mean(0), history[-5:].mean(0)
    assert history.shape == (40, 4)
    refined, normal, denoised, aligned = last / first
    assert max(refined, normal, aligned) < 0.9, (first, last)
    assert denoised < 1.5


def test_the_refiner_learns_from_eq_3_alone(phase, batch):
    """What only the other losses see does not change how it moves."""
    variables = phase.start.variables
    expected = steps(phase, batch, 3)[0].variables["params"]
    for name in ("auxiliary", "depth_encoder"):
        others = jax.tree.map(lambda leaf: 1.5 * leaf, variables["params"][name])
        changed = {**variables, "params": {**variables["params"], name: others}}
        moved = steps(phase, batch, 3, changed)[0].variables["params"]
        assert bitwise(moved["refiner"], expected["refiner"])
        assert not bitwise(moved[name], expected[name])


def test_and_the_branches_do_not_see_the_complete_cloud(phase, batch):
    expected = steps(phase, batch, 2)[0].variables["params"]
    other = batch._replace(complete=batch.complete[:, ::-1] * 0.5)
    moved = steps(phase, other, 2)[0].variables["params"]
    assert not bitwise(moved["refiner"], expected["refiner"])
    assert bitwise(moved["depth_encoder"], expected["depth_encoder"])
    assert bitwise(moved["auxiliary"], expected["auxiliary"])


def test_validation_scores_before_and_after_the_refiner(phase, batch, trained):
    variables = trained[0].variables
    scores = np.asarray(phase.validate_fn(variables, batch))
    assert scores.shape == (4, 3)
    assert np.isfinite(scores).all()
    assert not np.allclose(scores[:, 0], scores[:, 1])
    idle = jax.tree.map(jnp.zeros_like, variables["params"]["refiner"])
    params = {**variables["params"], "refiner": idle}
    other = np.asarray(phase.validate_fn({**variables, "params": params}, batch))
    assert np.array_equal(other[:, 0], scores[:, 0])
    doubled = batch._replace(scale=2 * batch.scale)
    larger = np.asarray(phase.validate_fn(variables, doubled))
    np.testing.assert_allclose(larger[:, :2], 4 * scores[:, :2], rtol=1e-6)
    np.testing.assert_allclose(larger[:, 2], scores[:, 2], rtol=1e-6)


def test_its_state_goes_through_a_checkpoint(phase, batch, tmp_path):
    """Two optimisers, each blind to the other's part; and no step compiles anew."""
    state, _ = steps(phase, batch, 2)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(2, state, None)
    restored = checkpoints.restore_latest(phase.start)
    checkpoints.close()
    assert bitwise(restored, state)
    restored = jax.device_put(jax.device_get(restored))
    expected, _ = phase.step_fn(state, batch)
    resumed, _ = phase.step_fn(restored, batch)
    assert bitwise(resumed, expected)
    assert phase.step_fn._cache_size() == 1
