"""Terms of the objective that the paper has not: what was seen to be empty, what was
right before, and terms balanced by their gradients."""

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from prism_jax import completion  # noqa: F401  (registers what is serialised)
from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.meta import meta_gradients
from prism_jax.adaptation.objective import COMMON, TOLERANCE, Losses, hold
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.geometry.visibility import seen_by, spacing_of
from prism_jax.losses.primary import primary_loss
from prism_jax.losses.visibility import contradiction, keep_loss, visibility_loss
from prism_jax.models.prism import predict, prepare_input
from prism_jax.models.variables import pop_encoders, put_encoders

WEIGHTS = {"depth_weight": 0.7, "visibility_weight": 3.0, "keep_weight": 2.0}


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config.with_adapt(**WEIGHTS, auxiliary_weight=0.5, num_steps=2)


@pytest.fixture(scope="module")
def frame(tiny_frames):
    partials, cameras = tiny_frames
    return partials[0], jax.tree.map(lambda leaf: leaf[0], cameras)


@pytest.fixture(scope="module")
def known(frame):
    partial, camera = frame
    return seen_by(partial, camera.position, "empty")


@pytest.fixture(scope="module")
def looked_at(config, frame, known, minimal_fresh, quick_jit):
    """Held inputs, plain and balanced, and what is made of them by moved encoders."""

    @quick_jit
    def look(variables, moved):
        partial, camera = frame
        key = jax.random.key(config.adapt.seed)
        inputs = prepare_input(partial, camera, key, config.model, visibility=known)
        held = hold(variables, inputs, config.with_adapt(balance=True))
        plain = held._replace(norms=None)
        encoders, rest = pop_encoders(variables)
        start, unravel = ravel_pytree(encoders)

        def terms(flat):
            losses, _ = objective(put_encoders(unravel(flat), rest), plain, config)
            return jnp.stack([*losses.named().values()])

        rows = jax.jacrev(terms)(start)
        after, prediction = objective(moved, plain, config)
        balanced, _ = objective(moved, held, config)
        before = predict(variables, held, config.model).points
        return held, terms(start), rows, after, balanced, prediction.points, before

    encoders, rest = pop_encoders(minimal_fresh)
    moved = jax.tree.map(lambda leaf: 1.05 * leaf, encoders)
    return look(minimal_fresh, put_encoders(moved, rest))


@pytest.mark.slow
def test_terms_are_those_of_their_losses(looked_at, frame, known):
    held, start, _, after, _, points, before = looked_at
    tolerance = TOLERANCE * spacing_of(frame[0])
    np.testing.assert_allclose(held.kept, before, atol=1e-6)
    allowed = contradiction(before, known, tolerance) == 0
    assert 0 < allowed.sum() < len(before)
    np.testing.assert_array_equal(held.kept_mask, allowed)
    seen = visibility_loss(points, known, tolerance)
    np.testing.assert_allclose(after.visibility, seen, rtol=1e-4)
    np.testing.assert_allclose(
        after.keep, keep_loss(points, before, allowed), rtol=1e-3
    )
    names = (*COMMON, "visibility", "keep")
    assert tuple(after.named()) == names
    assert dict(zip(names, start, strict=True))["keep"] == 0 < after.keep


@pytest.mark.slow
def test_the_objective_is_their_sum(looked_at, config, minimal_fresh):
    held, _, _, after, balanced, *_ = looked_at
    weighting = jax.device_get(minimal_fresh["weighting"])
    logits, scales = weighting["logits"], weighting["scales"]
    weights = np.exp(logits) / np.exp(logits).sum()
    scales = np.where(scales > 0, scales, 1.0)

    def total(losses, depth, scales, seen):
        found = 0.7 * losses.depth_consistency / depth
        found += 0.5 * (weights * np.asarray(losses.auxiliary) / scales).sum()
        return found + (3.0 * losses.visibility + 2.0 * losses.keep) / seen

    np.testing.assert_allclose(after.objective, total(after, 1, scales, 1), rtol=1e-5)
    depth, *auxiliary, seen = np.asarray(held.norms)
    expected = total(balanced, depth, np.array(auxiliary), seen)
    np.testing.assert_allclose(balanced.objective, expected, rtol=1e-5)
    assert after.visibility == balanced.visibility


@pytest.mark.slow
def test_norms_are_those_of_the_gradients_in_the_encoders(looked_at):
    """So that each term's first gradient has the length of its weight."""
    held, _, rows, *_ = looked_at
    norms = np.linalg.norm(np.asarray(rows), axis=1)
    # The first is the objective's own; what is kept has none yet.
    np.testing.assert_allclose(held.norms, norms[1:-1], rtol=1e-4)
    assert (np.asarray(held.norms) > 0).all() and norms[-1] == 0


def test_without_weights_there_are_no_such_terms(minimal, frame, minimal_fresh):
    """And nothing is held but how the network decodes."""
    partial, camera = frame
    shapes = jax.eval_shape(
        lambda variables: make_adapt(minimal.config)(variables, partial, camera),
        minimal_fresh,
    )
    assert (shapes.losses.visibility, shapes.losses.keep) == (None, None)

    def held(variables):
        inputs = prepare_input(partial, camera, jax.random.key(0), minimal.config.model)
        return hold(variables, inputs, minimal.config)

    held = jax.eval_shape(held, minimal_fresh)
    assert held.decoding is not None
    assert (held.kept, held.kept_mask, held.norms, held.visibility) == (None,) * 4


@pytest.mark.slow
@pytest.mark.parametrize("balance", [False, True])
def test_steps_lower_it_whatever_the_network_reads(
    config, frame, known, minimal_fresh, quick_jit, balance
):
    """With a map that is given, or with what the cloud says, one by one and mapped."""
    alone = config.with_adapt(
        **{**WEIGHTS, "depth_weight": 0.0},
        auxiliary_weight=0.0,
        balance=balance,
        step_size=3e-3,
        clip_norm=1.0,
    )
    adapt = make_adapt(alone)
    partial, camera = frame
    done = quick_jit(adapt)(minimal_fresh, partial, camera, known)
    seen = np.asarray(done.losses.visibility)
    assert done.accepted and seen.shape == (3,) and seen[-1] < seen[0]
    expected = 3.0 * seen + 2.0 * np.asarray(done.losses.keep)
    ratio = np.asarray(done.losses.objective) / expected
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
    assert balance or np.isclose(ratio[0], 1, rtol=1e-5)
    # None of it moves the depth stream.
    before, after = (
        v["depth_encoder"] for v in (minimal_fresh["params"], done.encoders)
    )
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)
    if balance:
        return
    several = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), (partial, camera))
    both = quick_jit(jax.vmap(adapt, (None, 0, 0)))(minimal_fresh, *several)
    # A bare cloud does not say what is empty: only what hides its surface costs.
    assert (both.losses.visibility[:, 0] < seen[0]).all()
    np.testing.assert_allclose(both.points[0], both.points[1])


def test_losses_can_be_exported_with_and_without_them():
    def losses(value):
        return Losses(*[value] * 5), Losses(*[value] * 7)

    exported = jax.export.export(jax.jit(losses))(jnp.float32(2))
    again = jax.export.deserialize(bytearray(exported.serialize()))
    few, many = again.call(jnp.float32(2))
    assert isinstance(few, Losses) and few.keep is None
    assert many.keep == many.visibility == few.align == 2


@pytest.mark.slow
def test_an_episode_rehearses_what_test_time_does(
    config, frame, known, minimal_fresh, quick_jit
):
    """Emptiness, what is kept and the balance among it."""
    settings = config.with_adapt(num_steps=1, step_size=1e-3, balance=True)
    meta = MetaConfig(
        beta_0=0.0, lambda_aux=0.0, weight_rule="meta", rehearse_depth=True
    )
    partial, camera = frame
    complete = jnp.concatenate([partial, -partial])

    @quick_jit
    def both(variables):
        key, model = jax.random.key(settings.adapt.seed), settings.model
        inputs = prepare_input(partial, camera, key, model, visibility=known)
        batch = jax.tree.map(lambda leaf: leaf[None], (inputs, complete))
        _, terms = meta_gradients(variables, *batch, settings, meta)
        done = make_adapt(settings)(variables, partial, camera, known)
        whole = put_encoders(done.encoders, pop_encoders(variables)[1])
        stages = predict(whole, hold(variables, inputs, settings), model).stages
        before = predict(variables, inputs, model).stages
        losses = (primary_loss(s, complete, meta.norm) for s in (stages, before))
        return done.accepted, terms.adapted, *losses

    accepted, rehearsed, adapted, before = both(minimal_fresh)
    assert accepted
    np.testing.assert_allclose(rehearsed, adapted, rtol=1e-5)
    assert abs(adapted - before) > 1e-4 * before
