"""Test-time adaptation: what moves, what does not, and when it is refused."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.test_time import make_adapt
from prism_jax.models.variables import ENCODERS, pop_encoders, put_encoders
from tests.trees import bitwise, is_zero, row

NUM_STEPS = 3


@pytest.fixture(scope="module")
def adapt(minimal):
    """Test-time adaptation, compiled once."""
    return jax.jit(make_adapt(minimal.config))


@pytest.fixture(scope="module")
def frames(tiny_frames):
    """The frames one by one, as arguments of ``adapt``."""
    return [row(tiny_frames, i) for i in range(len(tiny_frames[0]))]


@pytest.fixture(scope="module")
def adapted(adapt, minimal_fresh, frames):
    return [adapt(minimal_fresh, *frame) for frame in frames]


def is_finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def test_every_frame_gets_better_by_its_own_objective(adapted, minimal_fresh):
    """Scales that are zero, not measured yet, leave the terms as they are."""
    originals, _ = pop_encoders(minimal_fresh)
    for completion in adapted:
        losses = completion.losses
        assert completion.accepted and is_finite((completion.points, losses))
        assert {term.shape for term in losses} == {(NUM_STEPS + 1,)}
        assert losses.objective[-1] < losses.objective[0]
        auxiliary = np.mean([losses.normal, losses.denoise, losses.align], axis=0)
        expected = losses.depth_consistency + auxiliary
        np.testing.assert_allclose(losses.objective, expected, rtol=1e-6)
        np.testing.assert_allclose(completion.weights, [1 / 3] * 3, rtol=1e-6)
        assert not np.array_equal(completion.points, completion.before)
        assert set(completion.encoders) == set(ENCODERS)
        for name in ENCODERS:
            for module, tree in completion.encoders[name].items():
                assert not bitwise(tree, originals[name][module]), module


def refused(completion, variables):
    """Whether all that comes back is what was there before."""
    return (
        not completion.accepted
        and bitwise(completion.points, completion.before)
        and bitwise(completion.encoders, pop_encoders(variables)[0])
    )


def test_what_is_not_a_number_is_refused(adapt, minimal_fresh, frames, adapted):
    """In a point, or in a branch: then the completion itself is sound."""
    partial, camera = frames[0]
    completion = adapt(minimal_fresh, partial.at[5, 1].set(jnp.nan), camera)
    assert refused(completion, minimal_fresh)
    branch = minimal_fresh["params"]["auxiliary"]
    broken = jax.tree.map(lambda leaf: leaf * jnp.inf, branch["normal"])
    params = {**minimal_fresh["params"], "auxiliary": {**branch, "normal": broken}}
    variables = {**minimal_fresh, "params": params}
    completion = adapt(variables, partial, camera)
    assert refused(completion, variables)
    assert bitwise(completion.points, adapted[0].before)
    assert np.isnan(completion.losses.normal[0])


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
        assert is_finite((completion.points, completion.losses))
        first, *_, last = completion.losses.objective
        # The encoders that came back are those of the last losses.
        align = done.losses.align[-1]
        np.testing.assert_allclose(completion.losses.align[0], align, rtol=1e-4)
        rose.append(last > 1.01 * first)
        if rose[-1]:
            assert refused(completion, variables)
    assert any(rose)


def test_degenerate_frames_stay_finite(adapt, minimal_fresh, frames, adapted):
    partial, camera = frames[0]
    one_place = jnp.broadcast_to(partial[0], partial.shape)
    line = jnp.linspace(-0.7, 0.7, len(partial))[:, None] * partial[0]
    away = dataclasses.replace(camera, translation=-camera.translation)
    for frame in ((one_place, camera), (line, camera), (partial, away)):
        completion = adapt(minimal_fresh, *frame)
        assert is_finite((completion.points, completion.losses, completion.encoders))
    # Out of view, which was the last.
    assert (completion.losses.depth_consistency == 0).all()
    assert not np.allclose(completion.losses.align, adapted[0].losses.align)
    assert bitwise(completion.before, adapted[0].before)


def test_another_number_of_points(minimal, minimal_fresh, frames):
    with pytest.raises(ValueError, match="one cloud of 64 points"):
        make_adapt(minimal.config)(minimal_fresh, jnp.zeros((63, 3)), frames[0][1])


@pytest.mark.slow
def test_mapped_over_frames_it_is_the_loop(
    minimal, minimal_fresh, tiny_frames, adapted, quick_jit
):
    """Every frame with encoders of its own. Batched products add up in another order,
    which PCA magnifies in normals of neighbourhoods that are almost round."""
    mapped = quick_jit(jax.vmap(make_adapt(minimal.config), (None, 0, 0)))
    together = mapped(minimal_fresh, *tiny_frames)
    for i, alone in enumerate(adapted):
        one = row(together, i)
        assert one.accepted == alone.accepted
        np.testing.assert_allclose(one.points, alone.points, atol=5e-5)
        np.testing.assert_allclose(one.before, alone.before, atol=5e-6)
        for name, loss in one.losses._asdict().items():
            rtol = 1e-3 if name == "normal" else 1e-5
            expected = getattr(alone.losses, name)
            np.testing.assert_allclose(loss, expected, rtol=rtol, atol=1e-5)
        chex.assert_trees_all_close(one.encoders, alone.encoders, atol=1e-6, rtol=0)
    assert not bitwise(row(together, 0).encoders, row(together, 1).encoders)


@pytest.mark.slow
def test_inside_a_users_jit_and_grad(minimal, minimal_variables, frames, quick_jit):
    """To first order, the loss logits and the branches would have no gradient; scan and
    camera have none."""
    adapt = make_adapt(minimal.config.with_adapt(num_steps=1, adapt_norm=False))

    def loss(variables, partial, camera):
        completion = adapt(variables, partial, camera)
        return (completion.points**2).mean(), completion.accepted

    user = quick_jit(jax.grad(loss, argnums=(0, 1, 2), has_aux=True))
    (gradient, *by_input), accepted = user(minimal_variables, *frames[0])
    assert accepted and is_finite(gradient) and is_zero(by_input)
    assert not is_zero(gradient["weighting"]["logits"])
    for name in (*ENCODERS, "decoder", "refiner", "auxiliary"):
        assert not is_zero(gradient["params"][name]), name
