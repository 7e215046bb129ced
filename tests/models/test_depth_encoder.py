"""The depth stream."""

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


def test_depth_outside_the_mask_has_no_influence(variables):
    expected = encode(variables, DEPTH, MASK)
    for elsewhere in (5.0, np.nan, np.inf):
        changed = encode(variables, jnp.where(MASK, DEPTH, elsewhere), MASK)
        assert np.array_equal(changed, expected)

    total = jax.grad(lambda depth: (encode(variables, depth, MASK) ** 2).sum())
    gradient = np.asarray(jax.jit(total)(DEPTH))
    assert np.isfinite(gradient).all()
    assert (gradient[~np.asarray(MASK)] == 0).all() and (gradient != 0).any()


def test_depth_and_mask_both_count(variables):
    tokens = encode(variables, DEPTH, MASK)
    assert not np.allclose(encode(variables, DEPTH + 1, MASK), tokens)
    zero = jnp.zeros_like(DEPTH)
    here, nowhere = encode(variables, zero, MASK), encode(variables, zero, ~MASK)
    assert not np.allclose(here, nowhere)
    empty = encode(variables, DEPTH, jnp.zeros_like(MASK))
    assert np.isfinite(empty).all()


def test_frames_are_the_loop_and_their_statistics_move(variables):
    frames = jnp.stack([DEPTH, DEPTH.T, -DEPTH]), jnp.stack([MASK, MASK.T, ~MASK])
    together = jax.jit(jax.vmap(encode, (None, 0, 0)))(variables, *frames)
    alone = [encode(variables, *frame) for frame in zip(*frames, strict=True)]
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-5)

    @jax.jit
    def train(variables):
        apply = DepthEncoder(CONFIG).apply
        return apply(variables, *frames, True, mutable=["batch_stats"])

    _, updated = train(variables)
    pair = variables["batch_stats"], updated["batch_stats"]
    assert not any(jax.tree.leaves(jax.tree.map(np.array_equal, *pair)))
