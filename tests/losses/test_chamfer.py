"""Chamfer distance: values against a k-d tree and the parity arrays, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from prism_jax.losses.chamfer import chamfer

RNG = np.random.default_rng(0)
NORMS = ("l2", "l1")
FLOOR = 1e-9
PARITY_RTOL = 1e-5

value = jax.jit(chamfer, static_argnames="norm")
value_and_grad = jax.jit(
    jax.value_and_grad(chamfer, argnums=(0, 1)), static_argnames="norm"
)


def cloud(*shape: int) -> np.ndarray:
    return RNG.normal(size=(*shape, 3)).astype(np.float32)


def tree_chamfer(prediction, target, norm):
    forward, _ = KDTree(target).query(prediction)
    backward, _ = KDTree(prediction).query(target)
    if norm == "l2":
        return np.mean(forward**2) + np.mean(backward**2)
    root = np.sqrt(FLOOR)
    return 0.5 * np.mean(forward.clip(root)) + 0.5 * np.mean(backward.clip(root))


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("counts", [(300, 200), (1, 50), (50, 1)])
def test_agrees_with_a_tree(norm, counts):
    prediction, target = cloud(counts[0]), cloud(counts[1])
    expected = tree_chamfer(prediction, target, norm)
    assert np.allclose(value(prediction, target, norm=norm), expected, rtol=1e-5)


def test_agrees_with_the_reference(reference):
    arrays = reference("metrics.npz")
    pairs = {name.split("/")[1] for name in arrays if name.startswith("cloud/")}
    assert pairs >= {"rand", "sphere_noisy"}
    for pair in pairs:
        clouds = arrays[f"cloud/{pair}/pred"], arrays[f"cloud/{pair}/gt"]
        for norm, name in (("l2", "cd_l2"), ("l1", "cd_l1_clamp1e-9")):
            expected = arrays[f"val/{pair}/{name}"]
            found = value(*clouds, norm=norm)
            assert np.allclose(found, expected, rtol=PARITY_RTOL), (pair, name)


def test_l2_gradient_is_that_of_the_assignment():
    prediction, target = cloud(40), cloud(40)
    _, to_target = KDTree(target).query(prediction)
    _, to_prediction = KDTree(prediction).query(target)
    expected = 2 * (prediction - target[to_target]) / len(prediction)
    np.add.at(
        expected, to_prediction, 2 * (prediction[to_prediction] - target) / len(target)
    )
    _, (gradient, _) = value_and_grad(prediction, target, norm="l2")
    assert np.allclose(gradient, expected, atol=1e-6)


def test_first_and_second_derivatives(x64):
    # Unequal counts on a lattice of spacing 1, each point 0.1 to 0.3 off its site:
    # a finite difference of 1e-4 flips no assignment.
    lattice = np.argwhere(np.ones((2, 2, 2))).astype(float)
    prediction = jnp.asarray(lattice + RNG.uniform(0.05, 0.15, lattice.shape))
    target = jnp.asarray(lattice[:6] - RNG.uniform(0.05, 0.15, (6, 3)))
    for a, b in ((prediction, target), (target, prediction)):
        distances, _ = KDTree(b).query(a, k=2)
        assert np.min(distances[:, 1] - distances[:, 0]) > 0.01
    # The norms' slopes differ in size: one cannot make up for the other.
    check_grads(
        jax.jit(lambda p, t: jnp.stack([chamfer(p, t, norm) for norm in NORMS])),
        (prediction, target),
        order=2,
        modes=["rev"],
        eps=1e-4,
        atol=1e-5,
        rtol=1e-5,
    )


def test_value_and_gradient_stay_small_in_memory():
    size = jax.ShapeDtypeStruct((16384, 3), jnp.float32)
    compiled = jax.jit(jax.value_and_grad(chamfer)).lower(size, size).compile()
    memory = compiled.memory_analysis()
    assert memory is not None
    assert 0 < memory.temp_size_in_bytes < 300e6


@pytest.mark.parametrize("norm", NORMS)
def test_vmap_is_a_loop(norm):
    predictions, targets = cloud(3, 300), cloud(3, 200)
    batched = jax.jit(jax.vmap(lambda p, t: chamfer(p, t, norm)))(predictions, targets)
    looped = [value(p, t, norm=norm) for p, t in zip(predictions, targets, strict=True)]
    assert np.allclose(batched, looped, rtol=1e-6)


@pytest.mark.parametrize(("norm", "expected"), [("l2", 0.0), ("l1", FLOOR**0.5)])
def test_equal_clouds(norm, expected):
    points = cloud(40)
    distance, gradients = value_and_grad(points, points[::-1], norm=norm)
    assert np.allclose(distance, expected, rtol=1e-5, atol=0)
    assert all(np.all(np.asarray(g) == 0) for g in gradients)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("degenerate", ["repeated", "collinear"])
def test_degenerate_clouds(norm, degenerate):
    prediction = {
        "repeated": np.full((40, 3), 0.25, np.float32),
        "collinear": np.outer(np.arange(40), (0.5, 0.25, 0)).astype(np.float32),
    }[degenerate]
    target = cloud(40)
    distance, gradients = value_and_grad(prediction, target, norm=norm)
    expected = tree_chamfer(prediction, target, norm)
    assert np.allclose(distance, expected, rtol=1e-5)
    assert all(np.all(np.isfinite(g)) for g in gradients)
    assert any(np.any(np.asarray(g) != 0) for g in gradients)


def test_far_from_the_origin():
    # Multiples of 2^-8 plus 1024 are exact in float32.
    prediction = np.round(cloud(300) * 256) / np.float32(256)
    target = np.round(cloud(200) * 256) / np.float32(256)
    for norm in NORMS:
        near = value(prediction, target, norm=norm)
        far = value(prediction + 1024, target + 1024, norm=norm)
        assert np.allclose(near, far, rtol=1e-6)


def test_faults_are_named():
    with pytest.raises(ValueError, match="at least one point"):
        chamfer(jnp.zeros((0, 3)), jnp.ones((5, 3)))
    with pytest.raises(ValueError, match="at least one point"):
        chamfer(jnp.ones((5, 3)), jnp.zeros((0, 3)))


def test_nan_is_not_hidden():
    spoiled = cloud(40)
    spoiled[7, 1] = np.nan
    for pair in ((spoiled, cloud(40)), (cloud(40), spoiled)):
        assert np.isnan(value_and_grad(*pair, norm="l2")[0])
