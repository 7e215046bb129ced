"""Eq. 3 and Eq. 4: values against a loop, gradients to the front-most points."""

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.render import render_depth
from prism_jax.losses.depth import depth_error, depth_supervised
from tests.geometry.test_render import looped_render
from tests.trees import is_zero

RNG = np.random.default_rng(4)
# Looks along +z from z = -3, image rows along +y: the depth of a point is z + 3.
CAMERA = Camera(
    rotation=jnp.eye(3),
    translation=jnp.asarray([0.0, 0.0, 3.0]),
    intrinsics=jnp.asarray([[10.0, 0.0, 5.5], [0.0, 10.0, 5.5], [0.0, 0.0, 1.0]]),
    height=12,
    width=12,
)
supervised = jax.jit(jax.value_and_grad(depth_supervised, argnums=(0, 1)))


def cloud(*shape: int) -> np.ndarray:
    return RNG.uniform(-1.2, 1.2, (*shape, 3)).astype(np.float32)


def test_value_and_gradient_agree_with_a_loop():
    predicted, reference = cloud(150), cloud(90)
    _, front = looped_render(predicted, CAMERA)
    _, behind = looped_render(reference, CAMERA)
    shared = [*zip(*np.nonzero((front >= 0) & (behind >= 0)), strict=True)]
    assert 20 < len(shared) < min((front >= 0).sum(), (behind >= 0).sum())
    expected, expected_gradient = 0.0, np.zeros_like(predicted)
    for pixel in shared:
        difference = predicted[front[pixel], 2] - reference[behind[pixel], 2]
        expected += abs(difference) / len(shared)
        expected_gradient[front[pixel], 2] = np.sign(difference) / len(shared)
    value, (gradient, to_reference) = supervised(predicted, reference, CAMERA)
    assert np.allclose(value, expected, atol=1e-6)
    assert np.allclose(gradient, expected_gradient, atol=1e-6)
    assert is_zero(to_reference)


def test_reference_measured_by_a_sensor():
    """What stands outside its mask has no influence."""
    predicted, partial = jnp.asarray(cloud(80)), jnp.asarray(cloud(60))
    depth, mask = render_depth(partial, CAMERA)
    holes = jnp.where(mask, depth, jnp.nan)
    evaluate = jax.jit(jax.value_and_grad(depth_error, argnums=(0, 1)))
    value, (gradient, to_depth) = evaluate(predicted, holes, mask, CAMERA)
    expected, (expected_gradient, _) = supervised(predicted, partial, CAMERA)
    assert np.allclose(value, expected, rtol=1e-6) and value > 0
    assert np.allclose(gradient, expected_gradient, atol=1e-7)
    assert is_zero(to_depth)


def test_no_shared_pixel_gives_zero():
    reference = jnp.asarray(cloud(50))
    elsewhere = reference + jnp.asarray([50.0, 0.0, 0.0])
    for clouds in ((elsewhere, reference), (reference, elsewhere)):
        value, gradients = supervised(*clouds, CAMERA)
        assert value == 0 and is_zero(gradients)


def test_degenerate_clouds():
    """However many points share the front of the one pixel, they share one gradient."""
    reference = jnp.asarray([[0.0, 0.0, -1.0]])
    line = jnp.linspace(0, 1, 20)[:, None] * jnp.eye(1, 3)
    for predicted in (0 * line, line):
        value, (gradient, _) = supervised(predicted, reference, CAMERA)
        assert np.allclose(value, 1.0, atol=1e-6)
        assert np.allclose(np.sum(gradient, axis=0), (0, 0, 1), atol=1e-5)


def test_vmap_is_a_loop():
    predicted, partial = jnp.asarray(cloud(3, 80)), jnp.asarray(cloud(3, 60))
    batched, _ = jax.vmap(supervised, (0, 0, None))(predicted, partial, CAMERA)
    looped = [supervised(predicted[i], partial[i], CAMERA)[0] for i in range(3)]
    assert np.allclose(batched, looped, rtol=1e-6)
