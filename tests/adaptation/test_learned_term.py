"""A learned term in the objective: beside all others where it has a weight, and nothing
where it has none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from prism_jax.adaptation.objective import BALANCED, hold
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.io.errors import InputError
from prism_jax.losses.learned import MIDDLE, error_clues
from prism_jax.models.error_head import init_error_head, log_errors, with_term
from prism_jax.models.prism import prepare_input
from prism_jax.models.variables import pop_encoders, put_encoders
from prism_jax.weights import load_pretrained, save_weights
from tests.trees import bitwise

pytestmark = pytest.mark.slow  # whole networks, with second derivatives


@pytest.fixture(scope="module")
def frame(tiny_frames):
    partials, cameras = tiny_frames
    return partials[0], jax.tree.map(lambda leaf: leaf[0], cameras)


@pytest.fixture(scope="module")
def with_it(minimal_fresh):
    return with_term(minimal_fresh, init_error_head(jax.random.key(1)))


def test_without_a_weight_it_changes_no_bit(
    minimal, minimal_fresh, with_it, frame, quick_jit
):
    adapt = quick_jit(make_adapt(minimal.config.with_adapt(num_steps=1)))
    plain, beside = adapt(minimal_fresh, *frame), adapt(with_it, *frame)
    assert plain.losses.learned is None
    assert bitwise(plain, beside)


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config.with_adapt(learned_weight=2.0, depth_weight=0.7)


@pytest.fixture(scope="module")
def looked_at(config, with_it, frame, quick_jit):
    """The objective with and without its weight, the term by hand, its gradient's norm,
    and all of it balanced."""

    @quick_jit
    def look(variables):
        partial, camera = frame
        inputs = prepare_input(partial, camera, jax.random.key(0), config.model)
        held = hold(variables, inputs, config.with_adapt(balance=True))
        plain = held._replace(norms=None)
        losses, prediction = objective(variables, plain, config)
        without, _ = objective(variables, plain, config.with_adapt(learned_weight=0.0))
        balanced, _ = objective(variables, held, config)
        eye = camera.position
        clues = error_clues(prediction.points, partial, held.visibility, eye)
        by_hand = log_errors(variables["params"]["learned"], clues).mean()
        encoders, rest = pop_encoders(variables)
        start, unravel = ravel_pytree(encoders)

        def term(flat):
            losses, _ = objective(put_encoders(unravel(flat), rest), plain, config)
            return losses.learned

        norm = jnp.linalg.norm(jax.grad(term)(start))
        return losses, without, balanced, by_hand, norm, held.norms

    return look(with_it)


def test_the_objective_has_it_beside_the_others(looked_at):
    losses, without, balanced, by_hand, norm, norms = looked_at
    np.testing.assert_allclose(losses.learned, by_hand, rtol=1e-5)
    assert abs(by_hand - MIDDLE) < 3 and without.learned is None
    added = losses.objective - without.objective
    np.testing.assert_allclose(added, 2.0 * by_hand, rtol=1e-4)
    assert len(norms) == len(BALANCED) + 1 and norms[-2] == 0
    np.testing.assert_allclose(norms[-1], norm, rtol=1e-3)
    scaled = np.asarray(norms)[1:4]
    rest = 0.7 * balanced.depth_consistency / norms[0]
    rest += (np.asarray(balanced.auxiliary) / scaled).mean()
    added = balanced.objective - rest
    np.testing.assert_allclose(added, 2.0 * by_hand / norm, rtol=1e-3)


def test_steps_lower_what_it_expects(config, with_it, frame, quick_jit):
    alone = config.with_adapt(
        depth_weight=0.0,
        auxiliary_weight=0.0,
        num_steps=2,
        step_size=3e-3,
        clip_norm=1.0,
    )
    done = quick_jit(make_adapt(alone))(with_it, *frame)
    expected = np.asarray(done.losses.learned)
    assert done.accepted and expected.shape == (3,)
    assert (np.diff(expected) < 0).all()


def test_weights_without_it_cannot_descend_it(config, minimal_fresh, frame):
    with pytest.raises(ValueError, match=r"no learned term.*experiments\.learned_term"):
        jax.eval_shape(make_adapt(config), minimal_fresh, *frame)


def test_files_have_it_or_not(config, minimal, minimal_fresh, with_it, tmp_path):
    """And one whose configuration asks for it must."""
    for name, settings, variables in (
        ("with", minimal.config, with_it),
        ("asked", config, with_it),
        ("without", minimal.config, minimal_fresh),
    ):
        path = str(tmp_path / f"{name}.safetensors")
        save_weights(path, settings, variables, {})
        found = load_pretrained(path)
        assert found[0] == settings and bitwise(found[1], variables)
    path = str(tmp_path / "lacks.safetensors")
    save_weights(path, config, minimal_fresh, {})
    with pytest.raises(InputError, match=r"params/learned/.* is missing"):
        load_pretrained(path)
