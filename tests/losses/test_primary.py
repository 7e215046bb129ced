"""Eq. 10: sums over stages, and the reference's training loss."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from prism_jax.losses.primary import primary_loss, stage_chamfers

RNG = np.random.default_rng(1)
value_and_grad = jax.jit(jax.value_and_grad(primary_loss), static_argnames="norm")


def cloud(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=(*shape, 3)), jnp.float32)


def tree_cd_l2(a, b):
    return np.mean(KDTree(b).query(a)[0] ** 2) + np.mean(KDTree(a).query(b)[0] ** 2)


def test_each_stage_sees_as_many_points_of_the_complete_cloud():
    """And a longer one all of them."""
    stages, complete = (cloud(3, 8), cloud(3, 40)), cloud(3, 30)
    totals, gradients = jax.vmap(value_and_grad)(stages, complete)
    for i in range(3):
        alone = tuple(stage[i] for stage in stages)
        counts = zip(alone, (8, 30), strict=True)
        expected = sum(tree_cd_l2(stage, complete[i, :n]) for stage, n in counts)
        total, own = value_and_grad(alone, complete[i])
        assert np.allclose([total, totals[i]], expected, rtol=1e-5)
        for many, one in zip(gradients, own, strict=True):
            assert np.any(np.asarray(one) != 0)
            assert np.allclose(many[i], one, atol=1e-6)


def test_agrees_with_the_reference(reference):
    """Of all stages but the last, which takes long, and is no different."""
    arrays = reference("crapcn_pcn.npz")
    stages = tuple(jnp.asarray(arrays[f"official_f32/out_{i}"]) for i in range(3))
    # Every stage's target is a prefix of one order.
    complete = arrays[f"gt_{stages[2].shape[1]}"]

    @jax.jit
    @jax.vmap
    def both(stages, complete):
        return [stage_chamfers(stages, complete, norm) for norm in ("l1", "l2")]

    for values, name in zip(both(stages, complete), ("sqrt", "sq"), strict=True):
        expected = arrays[f"loss/clamp_{name}"][1:4]
        assert np.allclose(values.mean(0), expected, rtol=1e-5)


def test_collapsed_stages_have_finite_gradients():
    stages = (jnp.ones((1, 3)), jnp.zeros((12, 3)))
    _, gradients = value_and_grad(stages, cloud(12), norm="l1")
    assert all(np.all(np.isfinite(g)) for g in gradients)
