"""Eq. 10: sums over stages, and the reference's training loss."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.losses.primary import primary_loss, stage_chamfers

RNG = np.random.default_rng(1)
PARITY_RTOL = 1e-5

chamfers = jax.jit(stage_chamfers)
value_and_grad = jax.jit(jax.value_and_grad(primary_loss), static_argnames="norm")


def cloud(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=(*shape, 3)), jnp.float32)


def tree_cd_l2(a, b):
    return np.mean(KDTree(b).query(a)[0] ** 2) + np.mean(KDTree(a).query(b)[0] ** 2)


def test_each_stage_sees_as_many_points_of_the_complete_cloud():
    """And a longer one all of them."""
    complete = cloud(30)
    stages = (cloud(8), cloud(20), cloud(40))
    expected = [
        tree_cd_l2(s, complete[:n]) for s, n in zip(stages, (8, 20, 30), strict=True)
    ]
    assert np.allclose(chamfers(stages, complete), expected, rtol=1e-5)
    total, _ = value_and_grad(stages, complete)
    assert np.allclose(total, sum(expected), rtol=1e-5)


def test_agrees_with_the_reference(reference):
    arrays = reference("crapcn_pcn.npz")
    stages = tuple(jnp.asarray(arrays[f"official_f32/out_{i}"]) for i in range(4))
    # Every stage's target is a prefix of one order.
    sampled = stages[2].shape[1]
    complete = in_sampled_order(jnp.asarray(arrays["gt"]), sampled)
    assert np.array_equal(complete[:, :sampled], arrays[f"gt_{sampled}"])

    @jax.jit
    @jax.vmap
    def both(stages, complete):
        return [stage_chamfers(stages, complete, norm) for norm in ("l1", "l2")]

    for values, name in zip(both(stages, complete), ("sqrt", "sq"), strict=True):
        expected, values = arrays[f"loss/clamp_{name}"], values.mean(0)
        assert np.allclose(values, expected[1:5], rtol=PARITY_RTOL)
        assert np.allclose(1000 * values.sum(), expected[0], rtol=PARITY_RTOL)


@functools.partial(jax.jit, static_argnums=1)
@functools.partial(jax.vmap, in_axes=(0, None))
def in_sampled_order(points, count):
    order = farthest_point_sample(points, count, skip_near_origin=True)
    others = jnp.ones(len(points), bool).at[order].set(False)
    rest = jnp.nonzero(others, size=len(points) - count)[0]
    return points[jnp.concatenate([order, rest])]


def test_gradients_reach_every_stage_and_vmap_is_a_loop():
    stages, complete = (cloud(3, 8), cloud(3, 20), cloud(3, 40)), cloud(3, 30)
    _, batched = jax.vmap(value_and_grad)(stages, complete)
    for i in range(3):
        _, alone = value_and_grad(tuple(s[i] for s in stages), complete[i])
        for many, one in zip(batched, alone, strict=True):
            assert np.any(np.asarray(one) != 0)
            assert np.allclose(many[i], one, atol=1e-6)


def test_collapsed_stages_have_finite_gradients():
    stages = (jnp.ones((1, 3)), jnp.zeros((12, 3)))
    _, gradients = value_and_grad(stages, cloud(12), norm="l1")
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_faults_are_named():
    with pytest.raises(ValueError, match="at least one stage"):
        primary_loss((), cloud(4))
