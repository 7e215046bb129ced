"""The phase after the backbone's: what it trains, and on what."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.evaluation.metrics import score
from prism_jax.models.prism import Prediction
from prism_jax.training import auxiliary
from prism_jax.training.auxiliary import TRAINED, auxiliary_phase
from prism_jax.training.checkpoints import Checkpoints
from tests.trees import bitwise


@pytest.fixture(scope="module")
def phase(minimal, minimal_variables):
    training = dataclasses.replace(
        minimal.pretrain, auxiliary_samples=160, auxiliary_rate=0.01, batch_size=4
    )
    return auxiliary_phase(minimal_variables, minimal.config, training, seed=0)


def steps(phase, batch, count, **params):
    """The state after some steps, from a start with other parameters, and the terms."""
    before = phase.start.variables
    variables = {**before, "params": {**before["params"], **params}}
    state, history = phase.start._replace(variables=variables), []
    for _ in range(count):
        state, terms = phase.step_fn(state, batch)
        history.append(np.asarray(terms))
    return state, np.array(history)


def test_it_trains_these_and_nothing_of_the_backbone(phase, batch):
    state, history = steps(phase, batch, 3)
    before, after = phase.start.variables, state.variables
    assert set(before["params"]) == {*TRAINED, "point_encoder", "decoder"}
    for name in before["params"]:
        same = bitwise(before["params"][name], after["params"][name])
        assert same == (name not in TRAINED), name
    for name, tree in before["batch_stats"].items():
        same = bitwise(tree, after["batch_stats"][name])
        assert same == (name != "depth_encoder"), name
    for name, branch in before["params"]["auxiliary"].items():
        assert not bitwise(branch, after["params"]["auxiliary"][name]), name
    own = after["weighting"]
    assert bitwise(own["logits"], before["weighting"]["logits"])
    # Moving averages; the alignment is measured frame by frame.
    scales = history[0, 1:3]
    for losses in history[1:, 1:3]:
        scales = 0.99 * scales + 0.01 * losses
    np.testing.assert_allclose(own["scales"][:2], scales, rtol=1e-5)
    assert own["scales"][2] > 0


def test_the_refiner_learns_from_eq_3_alone_and_the_branches_from_theirs(phase, batch):
    """The branches do not see the complete cloud. The first step has no size: in the
    second, both begin where they began."""
    params = phase.start.variables["params"]
    expected = steps(phase, batch, 2)[0].variables["params"]
    branches = ("auxiliary", "depth_encoder")
    others = {
        name: jax.tree.map(lambda leaf: 1.5 * leaf, params[name]) for name in branches
    }
    moved = steps(phase, batch, 2, **others)[0].variables["params"]
    assert bitwise(moved["refiner"], expected["refiner"])
    smaller = batch._replace(complete=batch.complete[:, ::-1] * 0.5)
    moved = steps(phase, smaller, 2)[0].variables["params"]
    assert not bitwise(moved["refiner"], expected["refiner"])
    assert all(bitwise(moved[name], expected[name]) for name in branches)


def test_the_alignment_does_not_move_the_tokens_of_the_point_stream(phase, batch):
    """Where the denoiser does not, which looks at these tokens through `latent`. The
    first step has no size, so that is still zero in the second."""
    auxiliary = phase.start.variables["params"]["auxiliary"]
    before = dict(auxiliary["integrator"])
    before["latent"] = jax.tree.map(jnp.zeros_like, before["latent"])
    changed = {**auxiliary, "integrator": before}
    state, _ = steps(phase, batch, 2, auxiliary=changed)
    after = state.variables["params"]["auxiliary"]["integrator"]
    moved = {name for name in before if not bitwise(before[name], after[name])}
    assert moved == {"latent"}


def test_validation_scores_before_and_after_the_refiner(
    phase, batch, minimal, minimal_variables, monkeypatch
):
    """In the unit of the scores, of points that are known; and the sum of the losses.
    That of the network is traced alone."""
    variables = phase.start.variables
    assert jax.eval_shape(phase.validate_fn, variables, batch).shape == (4, 3)

    def terms(variables, inputs, features, batch, config):
        partial = jnp.asarray(batch.partial)
        made = Prediction(1.1 * partial, (partial,), None, None)
        return jnp.array([1.0, 2, 3, 4]), None, made

    monkeypatch.setattr(auxiliary, "_terms", terms)
    monkeypatch.setattr(auxiliary, "inputs_of", lambda batch, *given: batch.partial)
    monkeypatch.setattr(auxiliary.prism, "read_depth", lambda *given, config: given[1])
    training = dataclasses.replace(minimal.pretrain, auxiliary_samples=32, batch_size=4)
    own = auxiliary_phase(minimal_variables, minimal.config, training, seed=0)
    found = np.asarray(own.validate_fn(variables, batch))
    for row, partial, complete, scale in zip(
        found, *batch[:2], batch.scale, strict=True
    ):
        expected = [score(k * partial, complete).cd_l2 * scale**2 for k in (1, 1.1)]
        np.testing.assert_allclose(row, [*expected, 10.0], rtol=1e-4)


def test_its_state_goes_through_a_checkpoint(phase, batch, tmp_path):
    """Two optimisers, each blind to the other's part; and no step compiles anew."""
    state, _ = steps(phase, batch, 2)
    with contextlib.closing(Checkpoints(tmp_path)) as checkpoints:
        checkpoints.save(2, state, None)
        restored = checkpoints.restore(phase.start)
    assert bitwise(restored, state)
    restored = jax.device_put(jax.device_get(restored))
    phase.step_fn(restored, batch)
    assert phase.step_fn._cache_size() == 1


@pytest.mark.slow
def test_losses_fall_on_one_batch(phase, batch):
    """But the denoiser's, whose noise is another at every step: it starts that low."""
    _, history = steps(phase, batch, 40)
    first, last = history[:5].mean(0), history[-5:].mean(0)
    refined, normal, denoised, aligned = last / first
    assert max(refined, normal, aligned) < 0.9, (first, last)
    assert denoised < 1.5
