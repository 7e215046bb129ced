"""What holds of both networks that fold a grid around coarse points: PCN and FSC."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from experiments.baselines.fsc import FSC
from experiments.baselines.pcn import PCN
from prism_jax.losses.primary import primary_loss
from tests.experiments.baselines import test_fsc, test_pcn

NETWORKS = {"pcn": PCN(test_pcn.TINY), "fsc": FSC(test_fsc.TINY)}
RNG = np.random.default_rng(0)
PARTIAL = jnp.asarray(RNG.uniform(-1, 1, (3, 24, 3)), jnp.float32)
COMPLETE = jnp.asarray(RNG.uniform(-1, 1, (3, 32, 3)), jnp.float32)

DEGENERATE = {
    "one point many times": np.tile([[0.3, -0.2, 0.7]], (24, 1)),
    "one point": np.array([[0.3, -0.2, 0.7]]),
    "all at the origin": np.zeros((24, 3)),
    "collinear": np.linspace(-1, 1, 24)[:, None] * [1.0, 2.0, -1.0],
    "far from the origin": RNG.uniform(-1, 1, (24, 3)) + 1e4,
}


@pytest.fixture(scope="module", params=NETWORKS)
def network(request):
    return NETWORKS[request.param]


@pytest.fixture(scope="module")
def variables(network):
    """With biases that are not zero."""
    fresh = jax.jit(network.init)(jax.random.key(0), PARTIAL)
    return jax.tree.map(lambda leaf: leaf + 0.1 * (leaf.ndim == 1), fresh)


@pytest.fixture(scope="module")
def complete_fn(network, quick_jit):
    return quick_jit(network.apply)


@pytest.fixture(scope="module")
def loss_and_grad(network, quick_jit):
    """Eq. 10 over a batch, and its gradient in the variables."""

    def loss(variables, partial, complete):
        stages = network.apply(variables, partial)
        return jax.vmap(primary_loss)(stages, complete).mean()

    return quick_jit(jax.value_and_grad(loss))


def test_children_stand_around_their_coarse_point(complete_fn, variables):
    """And where nothing is folded, upon it."""
    flat = jax.tree_util.tree_map_with_path(
        lambda path, leaf: 0 * leaf if "fold" in str(path) else leaf, variables
    )
    coarse, fine = complete_fn(flat, PARTIAL)
    assert np.array_equal(fine, np.repeat(coarse, 4, axis=1))


def test_gradients_reach_every_parameter(loss_and_grad, variables):
    _, grads = loss_and_grad(variables, PARTIAL, COMPLETE)
    for leaf in jax.tree.leaves(grads):
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() > 0


@pytest.mark.usefixtures("x64")
def test_gradients_are_those_of_finite_differences(network, quick_jit, variables):
    """Along random directions, of a smooth function of both stages."""
    double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), variables)
    partial = jnp.asarray(PARTIAL, jnp.float64)

    @quick_jit
    @jax.value_and_grad
    def loss(variables):
        return sum(jnp.sin(3 * s).sum() for s in network.apply(variables, partial))

    _, grads = loss(double)
    rng, step = np.random.default_rng(2), 1e-7
    for _ in range(3):
        direction = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), double)
        ends = [
            loss(jax.tree.map(lambda x, d, h=h: x + h * d, double, direction))[0]
            for h in (step, -step)
        ]
        slope = sum(
            (g * d).sum()
            for g, d in zip(*map(jax.tree.leaves, (grads, direction)), strict=True)
        )
        difference = float(ends[0] - ends[1]) / (2 * step)
        assert difference == pytest.approx(float(slope), rel=1e-4)


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_clouds(name, complete_fn, loss_and_grad, variables):
    cloud = np.resize(DEGENERATE[name], (24, 3))
    partial = jnp.asarray(np.stack([cloud] * 3), jnp.float32)
    for stage in complete_fn(variables, partial):
        assert np.isfinite(stage).all()
    loss, grads = loss_and_grad(variables, partial, COMPLETE)
    assert np.isfinite(loss)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


def test_a_cloud_of_no_points(network, variables):
    with pytest.raises(ValueError, match="empty cloud"):
        jax.eval_shape(network.apply, variables, PARTIAL[:, :0])


def test_any_leading_axes(network, complete_fn, quick_jit, variables):
    """As a batch, mapped, one by one and folded into two axes, it is all the same."""
    together = complete_fn(variables, PARTIAL)
    mapped = quick_jit(jax.vmap(functools.partial(network.apply, variables)))(PARTIAL)
    nested = complete_fn(variables, PARTIAL.reshape(3, 1, 24, 3))
    alone = [complete_fn(variables, cloud) for cloud in PARTIAL]
    for i, stage in enumerate(together):
        np.testing.assert_allclose(mapped[i], stage, atol=1e-5)
        np.testing.assert_allclose(nested[i][:, 0], stage, atol=1e-5)
        for stages, expected in zip(alone, stage, strict=True):
            np.testing.assert_allclose(stages[i], expected, atol=1e-5)


@pytest.mark.slow
def test_some_steps_of_adam_lower_the_loss(loss_and_grad, quick_jit, variables):
    optimizer = optax.adam(3e-3)
    update = quick_jit(optimizer.update)
    state, losses = optimizer.init(variables), []
    for _ in range(20):
        loss, grads = loss_and_grad(variables, PARTIAL, COMPLETE)
        losses.append(float(loss))
        updates, state = update(grads, state)
        variables = optax.apply_updates(variables, updates)
    assert losses[-1] < 0.8 * losses[0]
