"""Chamfer distance and Eq. 10: values against trees and parity arrays, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from prism_jax.losses.chamfer import chamfer, primary_loss, stage_chamfers

RNG = np.random.default_rng(0)
NORMS = ("l2", "l1")
FLOOR = 1e-9


@jax.jit
def both(prediction, target):
    return jnp.stack([chamfer(prediction, target, norm) for norm in NORMS])


primary_slope = jax.jit(jax.value_and_grad(primary_loss), static_argnames="norm")
gradients = jax.jit(jax.jacrev(both, argnums=(0, 1)))


def cloud(*shape: int) -> np.ndarray:
    return RNG.normal(size=(*shape, 3)).astype(np.float32)


def tree_chamfers(prediction, target):
    forward, _ = KDTree(target).query(prediction)
    backward, _ = KDTree(prediction).query(target)
    root = np.sqrt(FLOOR)
    l1 = 0.5 * np.mean(forward.clip(root)) + 0.5 * np.mean(backward.clip(root))
    return np.mean(forward**2) + np.mean(backward**2), l1


@pytest.mark.parametrize("counts", [(300, 200), (1, 40)])
def test_agrees_with_a_tree(counts):
    """And so it does far away: multiples of 2^-8 plus 1024 are exact in float32."""
    clouds = [np.round(cloud(n) * 256) / np.float32(256) for n in counts]
    expected = tree_chamfers(*clouds)
    assert np.allclose(both(*clouds), expected, rtol=1e-5)
    assert np.allclose(both(*(c + 1024 for c in clouds)), expected, rtol=1e-5)


def test_agrees_with_the_reference(reference):
    arrays = reference("metrics.npz")
    for pair in ("rand", "sphere_noisy"):
        found = both(arrays[f"cloud/{pair}/pred"], arrays[f"cloud/{pair}/gt"])
        names = ("cd_l2", "cd_l1_clamp1e-9")
        expected = [arrays[f"val/{pair}/{name}"] for name in names]
        assert np.allclose(found, expected, rtol=1e-5), pair


def test_first_and_second_derivatives(x64):
    # Unequal counts on a lattice of spacing 1, each point 0.1 to 0.3 off its site:
    # a finite difference of 1e-4 flips no assignment.
    lattice = np.argwhere(np.ones((2, 2, 2))).astype(float)
    prediction = jnp.asarray(lattice + RNG.uniform(0.05, 0.15, lattice.shape))
    target = jnp.asarray(lattice[:6] - RNG.uniform(0.05, 0.15, (6, 3)))
    for a, b in ((prediction, target), (target, prediction)):
        distances, _ = KDTree(b).query(a, k=2)
        assert np.min(distances[:, 1] - distances[:, 0]) > 0.01
    pair, close = (prediction, target), {"atol": 1e-5, "rtol": 1e-5}
    check_grads(both, pair, order=2, modes=["rev"], eps=1e-4, **close)


def test_value_and_gradient_stay_small_in_memory():
    size = jax.ShapeDtypeStruct((16384, 3), jnp.float32)
    compiled = jax.jit(jax.value_and_grad(chamfer)).lower(size, size).compile()
    assert 0 < compiled.memory_analysis().temp_size_in_bytes < 300e6


def test_vmap_is_a_loop():
    predictions, targets = cloud(3, 300), cloud(3, 200)
    looped = [both(p, t) for p, t in zip(predictions, targets, strict=True)]
    assert np.allclose(jax.vmap(both)(predictions, targets), looped, rtol=1e-6)


def test_equal_clouds():
    points = cloud(40)
    expected = [0.0, FLOOR**0.5]
    assert np.allclose(both(points, points[::-1]), expected, rtol=1e-5, atol=0)
    for same in (points, points.astype(np.float16)):
        assert all(np.all(np.asarray(g) == 0) for g in gradients(same, same[::-1]))


def test_degenerate_clouds():
    """Repeated points, and a line."""
    target = cloud(40)
    for step in (0.0, 0.25):
        prediction = np.float32(0.25 + np.outer(np.arange(40), (2 * step, step, 0)))
        expected = tree_chamfers(prediction, target)
        assert np.allclose(both(prediction, target), expected, rtol=1e-5)
        assert all(np.all(np.isfinite(g)) for g in gradients(prediction, target))


def test_faults():
    with pytest.raises(ValueError, match="at least one point"):
        chamfer(jnp.zeros((5, 3)), jnp.zeros((0, 3)))
    spoiled = cloud(40)
    spoiled[7, 1] = np.nan
    for pair in ((spoiled, cloud(40)), (cloud(40), spoiled)):
        assert np.isnan(both(*pair)[0])


def test_each_stage_sees_as_many_points_of_the_complete_cloud():
    """And a longer one all of them."""
    stages, complete = (cloud(3, 8), cloud(3, 40)), cloud(3, 30)
    totals, gradients = jax.vmap(primary_slope)(stages, complete)
    for i in range(3):
        alone = tuple(stage[i] for stage in stages)
        counts = zip(alone, (8, 30), strict=True)
        expected = sum(tree_chamfers(stage, complete[i, :n])[0] for stage, n in counts)
        total, own = primary_slope(alone, complete[i])
        assert np.allclose([total, totals[i]], expected, rtol=1e-5)
        for many, one in zip(gradients, own, strict=True):
            assert np.any(np.asarray(one) != 0)
            assert np.allclose(many[i], one, atol=1e-6)


def test_stages_agree_with_the_reference(reference):
    """Of all stages but the last, which takes long, and is no different."""
    arrays = reference("crapcn_pcn.npz")
    stages = tuple(jnp.asarray(arrays[f"official_f32/out_{i}"]) for i in range(3))
    # Every stage's target is a prefix of one order.
    complete = arrays[f"gt_{stages[2].shape[1]}"]

    @jax.jit
    @jax.vmap
    def of_stages(stages, complete):
        return [stage_chamfers(stages, complete, norm) for norm in ("l1", "l2")]

    for values, name in zip(of_stages(stages, complete), ("sqrt", "sq"), strict=True):
        expected = arrays[f"loss/clamp_{name}"][1:4]
        assert np.allclose(values.mean(0), expected, rtol=1e-5)


def test_collapsed_stages_have_finite_gradients():
    stages = (jnp.ones((1, 3)), jnp.zeros((12, 3)))
    _, gradients = primary_slope(stages, cloud(12), norm="l1")
    assert all(np.all(np.isfinite(g)) for g in gradients)
