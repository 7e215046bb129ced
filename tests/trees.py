"""Trees of arrays: drawn, compared and averaged."""

import chex
import jax
import jax.numpy as jnp
import numpy as np


def drawn(module, *inputs):
    """Variables of any numbers, biases and statistics included: none of the
    compilation that fresh ones cost. In double precision where that is the default."""
    rng = np.random.default_rng(0)
    tree = jax.eval_shape(lambda: module.init(jax.random.key(0), *inputs))

    def draw(path, leaf):
        fans_in = leaf.shape[0] if leaf.ndim > 1 else 10
        values = rng.normal(size=leaf.shape) / fans_in**0.5
        values = abs(values) + 0.1 if path[-1].key == "var" else values
        return jnp.asarray(values, jnp.result_type(float))

    return jax.tree_util.tree_map_with_path(draw, tree)


def as_double(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree)


def mean(trees):
    return jax.tree.map(lambda *leaves: sum(leaves) / len(leaves), *trees)


def row(tree, i):
    return jax.tree.map(lambda leaf: leaf[i], tree)


def dot(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return float(sum((x * y).sum() for x, y in pairs))


def assert_close(found, expected, rtol):
    """Leaf by leaf, as a share of the leaf's largest number; what is below 1e-15 is
    rounding: a bias before a softmax has a gradient of zero."""
    chex.assert_trees_all_equal_structs(found, expected)
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(found),
        jax.tree.leaves(expected),
        strict=True,
    ):
        name = jax.tree_util.keystr(path)
        atol = max(rtol * float(np.abs(b).max()), 1e-15)
        np.testing.assert_allclose(a, b, rtol=0, atol=atol, err_msg=name)


def bitwise(a, b):
    """Equal leaf by leaf, dtype, NaN and the sign of zero included; trees of different
    structure raise."""
    chex.assert_trees_all_equal_structs(a, b)
    leaves = zip(*map(jax.tree.leaves, (a, b)), strict=True)
    pairs = [tuple(map(np.asarray, pair)) for pair in leaves]
    return all(x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in pairs)


def equal(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


def is_zero(tree):
    return all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(tree))
