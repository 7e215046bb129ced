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

loss = jax.jit(primary_loss, static_argnames="norm")
chamfers = jax.jit(stage_chamfers, static_argnames="norm")
gradient = jax.jit(jax.grad(primary_loss), static_argnames="norm")


def cloud(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=(*shape, 3)), jnp.float32)


def tree_cd_l2(a, b):
    return np.mean(KDTree(b).query(a)[0] ** 2) + np.mean(KDTree(a).query(b)[0] ** 2)


def test_each_stage_sees_as_many_points_of_the_complete_cloud():
    complete = cloud(96)
    stages = (cloud(16), cloud(48), cloud(96))
    expected = [
        tree_cd_l2(s, complete[:n]) for s, n in zip(stages, (16, 48, 96), strict=True)
    ]
    assert np.allclose(chamfers(stages, complete), expected, rtol=1e-5)
    assert np.allclose(loss(stages, complete), sum(expected), rtol=1e-5)


def test_a_longer_stage_sees_all_of_it():
    stage, complete = cloud(40), cloud(24)
    expected = tree_cd_l2(stage, complete)
    assert np.allclose(loss((stage,), complete), expected, rtol=1e-5)


@pytest.mark.parametrize(("norm", "name"), [("l1", "sqrt"), ("l2", "sq")])
def test_agrees_with_the_reference(reference, norm, name):
    arrays = reference("crapcn_pcn.npz")
    expected = arrays[f"loss/clamp_{name}"]
    stages = tuple(jnp.asarray(arrays[f"official_f32/out_{i}"]) for i in range(4))
    # Every stage's target is a prefix of one order.
    sampled = stages[2].shape[1]
    complete = in_sampled_order(jnp.asarray(arrays["gt"]), sampled)
    assert np.array_equal(complete[:, :sampled], arrays[f"gt_{sampled}"])
    values = jax.vmap(lambda s, c: chamfers(s, c, norm=norm))(stages, complete).mean(0)
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
    stages, complete = (cloud(3, 8), cloud(3, 20)), cloud(3, 30)
    batched = jax.vmap(gradient)(stages, complete)
    for i in range(3):
        alone = gradient(tuple(s[i] for s in stages), complete[i])
        for many, one in zip(batched, alone, strict=True):
            assert np.any(np.asarray(one) != 0)
            assert np.allclose(many[i], one, atol=1e-6)


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_collapsed_stages_have_finite_gradients(norm):
    stages = (jnp.ones((1, 3)), jnp.zeros((12, 3)))
    gradients = gradient(stages, cloud(12), norm=norm)
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_faults_are_named():
    with pytest.raises(ValueError, match="at least one stage"):
        primary_loss((), cloud(4))
