"""Test-time adaptation: what moves, what does not, and when it is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.objective import test_time_objective as losses_of
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.models.prism import hold_decoding, prepare_input
from prism_jax.models.variables import ENCODERS, pop_encoders, put_encoders
from tests.trees import bitwise

NUM_STEPS = 3


def with_scales(variables, scale):
    """The objective's auxiliary part, and so every step, divided by a scale."""
    weighting = {**variables["weighting"], "scales": jnp.full(3, scale, jnp.float32)}
    return {**variables, "weighting": weighting}


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config


@pytest.fixture(scope="module")
def adapt(config):
    """Test-time adaptation, compiled once."""
    return jax.jit(make_adapt(config))


@pytest.fixture(scope="module")
def frames(tiny_frames):
    """The frames one by one, as arguments of ``adapt``."""
    partials, cameras = tiny_frames
    return [
        (partials[i], jax.tree.map(lambda leaf, i=i: leaf[i], cameras))
        for i in range(len(partials))
    ]


@pytest.fixture(scope="module")
def adapted(adapt, minimal_fresh, frames):
    return [adapt(minimal_fresh, *frame) for frame in frames]


@pytest.fixture(scope="module")
def unadapted(config):
    """``adapt`` with no step at all, compiled once."""
    return jax.jit(make_adapt(config.with_adapt(num_steps=0)))


@pytest.fixture(scope="module")
def decoded_by(config, minimal_fresh):
    """Losses and completion by other encoders, with the samples and neighbours that the
    decoder had before they adapted."""

    @jax.jit
    def decoded(encoders, partial, camera):
        key = jax.random.key(config.adapt.seed)
        frame = prepare_input(partial, camera, key, config.model)
        frame = hold_decoding(minimal_fresh, frame, config.model)
        _, rest = pop_encoders(minimal_fresh)
        return losses_of(put_encoders(encoders, rest), frame, config)

    return decoded


@pytest.fixture(scope="module")
def differentiated(minimal, minimal_variables, frames, quick_jit):
    """The gradient of an adapted completion, in a user's own jit, and the completion.

    Taken in all variables, and in the partial cloud and its camera.
    """
    config = minimal.config.with_adapt(num_steps=1, adapt_norm=False)
    adapt = make_adapt(config)

    @quick_jit
    def user(variables, partial, camera):
        def loss(variables, partial, camera):
            completion = adapt(variables, partial, camera)
            return (completion.points**2).mean(), completion

        both = jax.grad(loss, argnums=(0, 1, 2), has_aux=True)
        return both(variables, partial, camera)

    return user(minimal_variables, *frames[0])


def test_every_frame_gets_better_by_its_own_objective(adapted):
    for completion in adapted:
        objective = np.asarray(completion.losses.objective)
        assert completion.accepted
        assert objective[-1] < objective[0]
        assert not np.array_equal(completion.points, completion.before)
        assert np.isfinite(completion.points).all()


def test_losses_of_every_step_and_after_the_last(adapted):
    for completion in adapted:
        for term in completion.losses._asdict().values():
            assert term.shape == (NUM_STEPS + 1,)
            assert np.isfinite(term).all()
    np.testing.assert_allclose(adapted[0].weights, [1 / 3, 1 / 3, 1 / 3], rtol=1e-6)


def test_objective_is_the_sum_of_the_terms_at_every_step(adapted):
    """Scales that are zero, not measured yet, leave the terms as they are."""
    losses = adapted[0].losses
    auxiliary = np.mean([losses.normal, losses.denoise, losses.align], axis=0)
    expected = losses.depth_consistency + auxiliary
    np.testing.assert_allclose(losses.objective, expected, rtol=1e-6)


def test_both_encoders_move(adapted, minimal_fresh):
    originals, _ = pop_encoders(minimal_fresh)
    for completion in adapted:
        assert set(completion.encoders) == set(ENCODERS)
        for name in ENCODERS:
            assert not bitwise(completion.encoders[name], originals[name])


@pytest.mark.slow
def test_they_explain_the_completion(adapted, decoded_by, frames):
    """With the rest that was given: so nothing else was used."""
    for completion, frame in zip(adapted, frames, strict=True):
        losses, prediction = decoded_by(completion.encoders, *frame)
        # Two programs: XLA fuses, and so rounds, each in its own way.
        np.testing.assert_allclose(prediction.points, completion.points, atol=1e-5)
        named = completion.losses._asdict()
        assert losses._asdict().keys() == named.keys()
        for a, b in zip(losses._asdict().values(), named.values(), strict=True):
            np.testing.assert_allclose(a, b[-1], rtol=1e-5)


def test_the_callers_variables_are_untouched(adapt, minimal_fresh, frames):
    before = jax.tree.map(lambda leaf: np.array(leaf, copy=True), minimal_fresh)
    assert adapt(minimal_fresh, *frames[0]).accepted
    assert bitwise(minimal_fresh, before)


def test_norms_adapt_with_their_encoder(adapted, minimal_fresh):
    originals, _ = pop_encoders(minimal_fresh)
    paths = jax.tree_util.tree_leaves_with_path(adapted[0].encoders)
    moved = {
        jax.tree_util.keystr(path): not np.array_equal(new, old)
        for (path, new), old in zip(paths, jax.tree.leaves(originals), strict=True)
    }
    scales = [moved[name] for name in moved if "norm" in name and "scale" in name]
    assert sum(scales) > len(scales) / 2


@pytest.mark.slow
def test_norms_that_are_held(differentiated, minimal_variables):
    _, completion = differentiated
    assert completion.accepted
    originals, _ = pop_encoders(minimal_variables)
    paths = jax.tree_util.tree_leaves_with_path(completion.encoders)
    count = 0
    for (path, new), old in zip(paths, jax.tree.leaves(originals), strict=True):
        if "norm" in jax.tree_util.keystr(path):
            assert bitwise(new, old)
            count += 1
    assert count > 10
    for name in ENCODERS:
        assert not bitwise(completion.encoders[name], originals[name])


def test_two_runs_are_bitwise_equal(adapt, minimal_fresh, frames, adapted):
    assert bitwise(adapt(minimal_fresh, *frames[0]), adapted[0])


@pytest.mark.slow
def test_mapped_over_frames_it_is_the_loop(
    tiny, tiny_variables, frames, tiny_frames, quick_jit
):
    """Every frame with encoders of its own.

    Not bitwise: batched products add up in another order. float32 keeps the
    encoders to 1e-6; the untrained network magnifies that tenfold in the points, and
    PCA a thousandfold in normals of neighbourhoods that are almost round.
    """
    adapt = make_adapt(tiny)
    mapped = quick_jit(jax.vmap(adapt, (None, 0, 0)))
    together = mapped(tiny_variables, *tiny_frames)
    assert together.accepted.shape == (3,)
    adapt = quick_jit(adapt)
    for i, frame in enumerate(frames):
        alone = adapt(tiny_variables, *frame)
        one = jax.tree.map(lambda leaf, i=i: leaf[i], together)
        assert one.accepted == alone.accepted
        np.testing.assert_allclose(one.points, alone.points, atol=5e-5)
        np.testing.assert_allclose(one.before, alone.before, atol=5e-6)
        for name in one.losses._asdict():
            a, b = getattr(one.losses, name), getattr(alone.losses, name)
            rtol = 1e-3 if name == "normal" else 1e-5
            np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-5)
        new, old = jax.tree.leaves(one.encoders), jax.tree.leaves(alone.encoders)
        for a, b in zip(new, old, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
    assert not bitwise(
        jax.tree.map(lambda leaf: leaf[0], together.encoders),
        jax.tree.map(lambda leaf: leaf[1], together.encoders),
    )


def test_without_steps_nothing_is_adapted(unadapted, minimal_fresh, frames, adapted):
    completion = unadapted(minimal_fresh, *frames[0])
    assert not completion.accepted
    assert bitwise(completion.points, completion.before)
    assert bitwise(completion.encoders, pop_encoders(minimal_fresh)[0])
    assert all(term.shape == (1,) for term in completion.losses._asdict().values())
    np.testing.assert_allclose(completion.points, adapted[0].before, atol=1e-5)
    first = adapted[0].losses.objective[0]
    np.testing.assert_allclose(completion.losses.objective[0], first, rtol=1e-5)


def refused(completion, variables):
    """Whether all that comes back is what was there before."""
    return (
        not completion.accepted
        and bitwise(completion.points, completion.before)
        and bitwise(completion.encoders, pop_encoders(variables)[0])
    )


def test_a_point_that_is_not_a_number_is_refused(adapt, minimal_fresh, frames):
    partial, camera = frames[0]
    completion = adapt(minimal_fresh, partial.at[5, 1].set(jnp.nan), camera)
    assert refused(completion, minimal_fresh)


def test_a_broken_branch_is_refused(adapt, minimal_fresh, frames, adapted):
    """The completion itself is sound, and comes back."""
    branch = minimal_fresh["params"]["auxiliary"]
    broken = jax.tree.map(lambda leaf: leaf * jnp.inf, branch["normal"])
    params = {**minimal_fresh["params"], "auxiliary": {**branch, "normal": broken}}
    variables = {**minimal_fresh, "params": params}
    completion = adapt(variables, *frames[0])
    assert refused(completion, variables)
    assert bitwise(completion.points, adapted[0].before)
    assert np.isfinite(completion.points).all()
    assert np.isnan(completion.losses.normal[0])
    assert np.isfinite(completion.losses.align[0])


def test_enormous_steps_are_refused(adapt, minimal_fresh, frames, adapted):
    variables = with_scales(minimal_fresh, 1e-9)
    completion = adapt(variables, *frames[0])
    assert not np.isfinite(completion.losses.objective[-1])
    assert refused(completion, variables)
    assert bitwise(completion.points, adapted[0].before)


def test_an_objective_that_rose_is_refused(adapt, minimal_fresh, frames, adapted):
    """As it does where long steps leave encoders that have adapted already."""
    learned = minimal_fresh["weighting"]["log_steps"]
    longer = jax.tree.map(lambda step: step + 6.0, learned)
    weighting = {**minimal_fresh["weighting"], "log_steps": longer}
    _, rest = pop_encoders({**minimal_fresh, "weighting": weighting})
    rose = []
    for done, frame in zip(adapted, frames, strict=True):
        variables = put_encoders(done.encoders, rest)
        completion = adapt(variables, *frame)
        objective = np.asarray(completion.losses.objective)
        assert np.isfinite(np.stack(list(completion.losses._asdict().values()))).all()
        assert np.isfinite(completion.points).all()
        rose.append(objective[-1] > 1.01 * objective[0])
        if rose[-1]:
            assert refused(completion, variables)
    assert any(rose)


@pytest.mark.parametrize("kind", ["one place", "a line", "out of view"])
def test_degenerate_frames_stay_finite(adapt, minimal_fresh, frames, kind):
    partial, camera = frames[0]
    if kind == "one place":
        partial = jnp.broadcast_to(partial[0], partial.shape)
    elif kind == "a line":
        partial = jnp.linspace(-0.7, 0.7, len(partial))[:, None] * partial[0]
    else:
        camera = dataclasses.replace(camera, translation=-camera.translation)
    completion = adapt(minimal_fresh, partial, camera)
    assert np.isfinite(completion.points).all()
    assert np.isfinite(np.stack(list(completion.losses._asdict().values()))).all()
    leaves = jax.tree.leaves(completion.encoders)
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    if kind == "out of view":
        assert (completion.losses.depth_consistency == 0).all()


def test_the_camera_matters(adapt, minimal_fresh, frames, adapted):
    other = adapt(minimal_fresh, frames[0][0], frames[1][1])
    assert not np.allclose(other.losses.align, adapted[0].losses.align)
    assert bitwise(other.before, adapted[0].before)


def test_another_number_of_points(config, minimal_fresh, frames):
    camera = frames[0][1]
    for count in (0, 63, 65):
        with pytest.raises(ValueError, match="one cloud of 64 points"):
            make_adapt(config)(minimal_fresh, jnp.zeros((count, 3)), camera)


@pytest.mark.slow
def test_inside_a_users_jit_and_grad(differentiated):
    (gradient, *by_input), completion = differentiated
    assert completion.accepted
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    # The scan and its camera are given: nothing is learned about them.
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(by_input))
    for name in ("point_encoder", "decoder", "refiner"):
        leaves = jax.tree.leaves(gradient["params"][name])
        assert any(np.abs(leaf).max() > 0 for leaf in leaves), name


@pytest.mark.slow
def test_meta_gradients_are_of_second_order(differentiated):
    """A first-order loop gives the loss logits and the branches none at all."""
    (gradient, *_), _ = differentiated
    assert np.abs(gradient["weighting"]["logits"]).max() > 0
    for name in ("depth_encoder", "auxiliary"):
        leaves = jax.tree.leaves(gradient["params"][name])
        assert any(np.abs(leaf).max() > 0 for leaf in leaves), name
