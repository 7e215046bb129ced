"""PCN against its formulas, and what the paper claims of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.baselines.pcn import PCN, PCN_SMALL, PCNConfig, folding_grid

TINY = PCNConfig(
    num_points=24,
    local_features=(8, 16),
    global_features=(16, 32),
    coarse_features=(32, 32),
    num_coarse=8,
    fold_features=(16, 16),
    grid_size=2,
)
RNG = np.random.default_rng(0)
PARTIAL = jnp.asarray(RNG.uniform(-1, 1, (3, 24, 3)), jnp.float32)


@pytest.fixture(scope="module")
def variables():
    """With biases that are not zero."""
    fresh = jax.jit(PCN(TINY).init)(jax.random.key(0), PARTIAL)
    return jax.tree.map(lambda leaf: leaf + 0.1 * (leaf.ndim == 1), fresh)


@pytest.fixture(scope="module")
def complete_fn(quick_jit):
    return quick_jit(PCN(TINY).apply)


def by_hand(variables, partial):
    """The paper's two equations for one cloud, with every concatenation made."""
    params = jax.tree.map(np.float64, variables["params"])

    def mlp(name, x):
        layers = [params[name][f"dense_{i}"] for i in range(len(params[name]))]
        for layer in layers[:-1]:
            x = np.maximum(x @ layer["kernel"] + layer["bias"], 0)
        return x @ layers[-1]["kernel"] + layers[-1]["bias"]

    f = mlp("local", np.float64(partial))
    f = mlp("global", np.concatenate([f, np.tile(f.max(0), (len(f), 1))], 1))
    feature = f.max(0)
    coarse = mlp("coarse", feature).reshape(8, 3)
    dense = [
        center + mlp("fold", np.concatenate([[u, v], center, feature]))
        for center in coarse
        for v in (-0.05, 0.05)
        for u in (-0.05, 0.05)
    ]
    return coarse, np.array(dense)


def test_the_papers_formulas(complete_fn, variables):
    coarse, dense = complete_fn(variables, PARTIAL)
    for i in range(3):
        expected = by_hand(variables, PARTIAL[i])
        np.testing.assert_allclose(coarse[i], expected[0], atol=2e-6)
        np.testing.assert_allclose(dense[i], expected[1], atol=2e-6)


def test_published_number_of_parameters():
    """The fully connected layers of the authors' code, each with a bias."""
    layers = [
        *[(3, 128), (128, 256)],
        *[(2 * 256, 512), (512, 1024)],
        *[(1024, 1024), (1024, 1024), (1024, 3 * 1024)],
        *[(2 + 3 + 1024, 512), (512, 512), (512, 3)],
    ]
    assert count(PCNConfig()) == sum(i * o + o for i, o in layers) == 6_861_059
    assert count(PCN_SMALL) == 1_127_427


def count(config):
    partial = jax.ShapeDtypeStruct((1, config.num_points, 3), jnp.float32)
    variables = jax.eval_shape(PCN(config).init, jax.random.key(0), partial)
    assert set(variables) == {"params"}
    return sum(leaf.size for leaf in jax.tree.leaves(variables))


def test_published_grid():
    """Four by four points, 0.1 wide, evenly spaced around the origin."""
    grid = np.asarray(folding_grid(4, 0.05))
    assert grid.shape == (16, 2)
    assert len(np.unique(grid.round(6), axis=0)) == 16
    values = np.unique(grid.round(6))
    np.testing.assert_allclose(values, [-0.05, -0.05 / 3, 0.05 / 3, 0.05], atol=1e-6)


def test_order_and_repetition_of_the_points_do_not_matter(complete_fn, variables):
    expected = complete_fn(variables, PARTIAL)
    order = np.random.default_rng(1).permutation(24)
    twice = jnp.concatenate([PARTIAL, PARTIAL[:, :7]], axis=1)
    for other in (PARTIAL[:, order], twice):
        for a, b in zip(complete_fn(variables, other), expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
    changed = complete_fn(variables, PARTIAL.at[:, 0].add(0.5))
    assert np.abs(np.asarray(changed[1]) - np.asarray(expected[1])).max() > 1e-3
