"""Eq. 7-9: statistics against NumPy, transport against OTT-JAX, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from ott.geometry import geometry
from ott.solvers import linear
from scipy.spatial.distance import cdist

from prism_jax.geometry.transport import sinkhorn
from prism_jax.losses.alignment import (
    alignment_loss,
    manifold_matching,
    transport_alignment,
)

RNG = np.random.default_rng(7)

align = jax.jit(alignment_loss, static_argnums=(2, 3))
transport = jax.jit(transport_alignment, static_argnums=(2, 3))
gradients = jax.jit(jax.grad(alignment_loss, argnums=(0, 1)))


def tokens(count: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=(count, 5)), jnp.float32)


def test_manifold_matching_agrees_with_numpy():
    a, b = tokens(20), 2 * tokens(30) + 1
    means = np.sum((a.mean(0) - b.mean(0)) ** 2)
    covariances = np.sum((np.cov(a.T, bias=True) - np.cov(b.T, bias=True)) ** 2)
    value = jax.jit(lambda a, b: manifold_matching(a, b, 0.7))(a, b)
    assert np.allclose(value, means + 0.7 * covariances, rtol=1e-5)


def test_transport_agrees_with_ott():
    """In any unit of the tokens."""
    a, b = tokens(12), tokens(17) + 0.5
    cost = cdist(a, b, "sqeuclidean").astype(np.float32)
    problem = geometry.Geometry(cost, epsilon=0.1 * float(cost.mean()))
    solution = linear.solve(problem, threshold=1e-6, max_iterations=5000)
    for scale in (1e-4, 1.0, 1e4):
        expected = scale**2 * np.sum(solution.matrix * cost)
        converged = transport(scale * a, scale * b, 0.1, num_iterations=1000)
        assert np.allclose(converged, expected, rtol=1e-3 if scale != 1 else 1e-4)
        assert np.allclose(transport(scale * a, scale * b, 0.1), expected, rtol=1e-2)


def test_alignment_is_the_sum_of_its_terms():
    a, b = tokens(12), tokens(17)
    expected = manifold_matching(a, b, 0.5) + 3.0 * transport(a, b)
    assert np.allclose(align(a, b, 0.5, 3.0), expected, rtol=1e-5)


def test_gradients_with_epsilon_held_still(x64):
    a, b = jnp.asarray(tokens(6), float), jnp.asarray(tokens(7), float)
    held = 0.05 * jnp.mean(jnp.sum((a[:, None] - b[None]) ** 2, axis=-1))

    @jax.jit
    def reference(a, b):
        cost = jnp.sum((a[:, None] - b[None]) ** 2, axis=-1)
        transported = sinkhorn(cost, held, num_iterations=30)[1]
        return manifold_matching(a, b) + transported

    check_grads(reference, (a, b), order=2, modes=["rev"], eps=1e-5)
    expected = jax.jit(jax.grad(reference, argnums=(0, 1)))(a, b)
    for got, wanted in zip(gradients(a, b), expected, strict=True):
        assert np.allclose(got, wanted, rtol=1e-8)


@pytest.mark.parametrize("counts", [(1, 8), (8, 8)])
def test_degenerate_tokens(counts):
    """One point against another: both terms are the squared distance."""
    a, b = jnp.full((counts[0], 5), 3.0), jnp.full((counts[1], 5), 3.0)
    assert np.allclose(align(a, b), 0)
    assert np.allclose(align(a, b + 2.0), 2 * 5 * 2.0**2, rtol=1e-5)
    line, far = jnp.outer(jnp.arange(8.0), jnp.ones(5)), tokens(8) + 1e4
    for pair in ((a, b), (a, b + 2.0), (line, line), (line, far), (far, far)):
        pair = tuple(x[:n] for x, n in zip(pair, counts, strict=True))
        assert np.isfinite(align(*pair))
        assert all(np.all(np.isfinite(g)) for g in gradients(*pair))
