"""The depth stream."""

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.depth_encoder import DepthEncoder

CONFIG = AuxiliaryConfig(depth_features=(4, 8), depth_blocks=2)
RNG = np.random.default_rng(0)
DEPTH = jnp.asarray(RNG.normal(size=(32, 32)), jnp.float32)
MASK = jnp.asarray(RNG.random((32, 32)) < 0.4)

encode = jax.jit(DepthEncoder(CONFIG).apply)


@pytest.fixture(scope="module")
def variables():
    return jax.jit(DepthEncoder(CONFIG).init)(jax.random.key(0), DEPTH, MASK)


@pytest.mark.parametrize("elsewhere", [5.0, np.nan, np.inf])
def test_depth_outside_the_mask_has_no_influence(variables, elsewhere):
    expected = encode(variables, DEPTH, MASK)
    changed = encode(variables, jnp.where(MASK, DEPTH, elsewhere), MASK)
    for a, b in zip(*map(jax.tree.leaves, (changed, expected)), strict=True):
        assert np.array_equal(a, b)


def test_nor_has_it_a_gradient_there(variables):
    def loss(depth):
        return (encode(variables, depth, MASK).tokens ** 2).sum()

    gradient = np.asarray(jax.jit(jax.grad(loss))(DEPTH))
    assert np.isfinite(gradient).all()
    assert (gradient[~np.asarray(MASK)] == 0).all()
    assert (gradient[np.asarray(MASK)] != 0).any()


def test_depth_and_mask_both_count(variables):
    tokens = encode(variables, DEPTH, MASK).tokens
    assert not np.allclose(encode(variables, DEPTH + 1, MASK).tokens, tokens)
    zero = jnp.zeros_like(DEPTH)
    here, nowhere = encode(variables, zero, MASK), encode(variables, zero, ~MASK)
    assert not np.allclose(here.tokens, nowhere.tokens)


def test_tokens_are_the_cells_of_the_last_map(variables):
    features = encode(variables, DEPTH, MASK)
    # 32 pixels halved by stem, pooling and the second stage.
    assert features.tokens.shape == (4 * 4, 8)
    np.testing.assert_allclose(features.pooled, features.tokens.mean(0), rtol=1e-6)


def test_an_empty_view_is_finite(variables):
    features = encode(variables, DEPTH, jnp.zeros_like(MASK))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(features))


def test_statistics_move_in_training_alone(variables):
    module = DepthEncoder(CONFIG)
    batch = jnp.stack([DEPTH, 2 * DEPTH]), jnp.stack([MASK, MASK])
    train = jax.jit(lambda v: module.apply(v, *batch, True, mutable=["batch_stats"]))
    _, updated = train(variables)
    before = jax.tree.leaves(variables["batch_stats"])
    after = jax.tree.leaves(updated["batch_stats"])
    assert all(not np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    with pytest.raises(flax.errors.ModifyScopeVariableError):
        module.apply(variables, *batch, True)


def test_mapped_over_frames_it_is_the_loop(variables):
    depths = jnp.stack([DEPTH, DEPTH.T, -DEPTH])
    masks = jnp.stack([MASK, MASK.T, ~MASK])
    together = jax.jit(jax.vmap(encode, (None, 0, 0)))(variables, depths, masks)
    batched = encode(variables, depths, masks)
    for i in range(3):
        alone = encode(variables, depths[i], masks[i])
        np.testing.assert_allclose(together.tokens[i], alone.tokens, atol=1e-5)
        np.testing.assert_allclose(batched.tokens[i], alone.tokens, atol=1e-5)
