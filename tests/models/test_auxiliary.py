"""Auxiliary branches: shapes, bounds, gradients where a norm or a root could break."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.models.auxiliary import (
    Denoiser,
    DepthProjection,
    NormalHead,
    TokenIntegrator,
)
from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.depth_encoder import DepthFeatures
from prism_jax.models.encoder import PointFeatures

CONFIG = AuxiliaryConfig(num_tokens=4, token_features=8, hidden=8)
RNG = np.random.default_rng(0)


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


ENCODED = PointFeatures(
    normal(12, 3), normal(12, 5), normal(6), np.zeros((12, 4), np.int32)
)
POINTS, FEATURES = normal(20, 3), normal(20, 7)
NEIGHBORS = jnp.asarray(RNG.integers(0, 20, (20, 4)))
LATENT = normal(8)
DEPTH = DepthFeatures(normal(9, 5), normal(5))

INPUTS = {
    TokenIntegrator: (ENCODED,),
    DepthProjection: (DEPTH,),
    NormalHead: (POINTS, FEATURES),
    Denoiser: (POINTS, NEIGHBORS, LATENT),
}


@pytest.fixture(scope="module")
def branches():
    """``{module: (its compiled apply, its variables)}``."""
    out = {}
    for module, inputs in INPUTS.items():
        variables = jax.jit(module(CONFIG).init)(jax.random.key(1), *inputs)
        out[module] = jax.jit(module(CONFIG).apply), variables
    return out


def test_shapes(branches):
    def shapes(module):
        apply, variables = branches[module]
        return jax.tree.map(jnp.shape, apply(variables, *INPUTS[module]))

    assert tuple(shapes(TokenIntegrator)) == ((4, 8), (8,))
    assert shapes(DepthProjection) == (9, 8)
    assert shapes(NormalHead) == (20, 3)
    assert shapes(Denoiser) == (20, 3)


def test_normals_have_unit_length(branches):
    apply, variables = branches[NormalHead]
    lengths = np.linalg.norm(apply(variables, POINTS, FEATURES), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-4)


def test_a_normal_head_that_returns_zero_has_finite_gradients(branches):
    apply, variables = branches[NormalHead]
    zeros = jax.tree.map(jnp.zeros_like, variables)
    gradient = jax.jit(jax.grad(lambda v: apply(v, POINTS, FEATURES).sum()))(zeros)
    assert np.array_equal(apply(zeros, POINTS, FEATURES), np.zeros((20, 3)))
    leaves = jax.tree.leaves(gradient)
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert any(np.abs(leaf).max() > 0 for leaf in leaves)


def test_tokens_of_both_streams_are_normalised(branches):
    """Without parameters: their scale cannot run away, or shrink to nothing."""
    apply, variables = branches[DepthProjection]
    tokens = np.asarray(apply(variables, DEPTH))
    np.testing.assert_allclose(tokens.mean(-1), 0, atol=1e-6)
    np.testing.assert_allclose(tokens.std(-1), 1, atol=1e-3)
    apply, variables = branches[TokenIntegrator]
    tokens = np.asarray(apply(variables, ENCODED).tokens)
    np.testing.assert_allclose(tokens.mean(-1), 0, atol=1e-6)
    np.testing.assert_allclose(tokens.std(-1), 1, atol=1e-3)


def test_tokens_do_not_depend_on_the_order_of_the_patches(branches):
    apply, variables = branches[TokenIntegrator]
    order = RNG.permutation(12)
    shuffled = ENCODED._replace(
        patch_xyz=ENCODED.patch_xyz[order],
        patch_features=ENCODED.patch_features[order],
    )
    for a, b in zip(apply(variables, shuffled), apply(variables, ENCODED), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_offsets_start_small_and_look_at_neighbours_only(branches):
    apply, variables = branches[Denoiser]
    offsets = np.asarray(apply(variables, POINTS, NEIGHBORS, LATENT))
    assert 0 < np.abs(offsets).max() < 0.2
    moved = apply(variables, POINTS.at[7].add(1.0), NEIGHBORS, LATENT)
    touched = (np.asarray(NEIGHBORS) == 7).any(-1) | (np.arange(20) == 7)
    changed = (np.asarray(moved) != offsets).any(-1)
    assert changed[touched].any()
    assert not changed[~touched].any()


@pytest.mark.parametrize("module", INPUTS)
def test_gradients_are_finite_for_inputs_that_are_all_zero(branches, module):
    apply, variables = branches[module]

    def empty(leaf):
        is_float = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.zeros_like(leaf) if is_float else leaf

    def loss(variables, inputs):
        outputs = jax.tree.leaves(apply(variables, *inputs))
        return sum((leaf**2).sum() for leaf in outputs)

    zeros = jax.tree.map(empty, INPUTS[module])
    gradient = jax.grad(loss, argnums=(0, 1), allow_int=True)
    grads = jax.tree.leaves(jax.jit(gradient)(variables, zeros))
    grads = [leaf for leaf in grads if leaf.dtype != jax.dtypes.float0]
    assert len(grads) > len(jax.tree.leaves(variables))
    assert all(np.isfinite(leaf).all() for leaf in grads)


@pytest.mark.parametrize("module", INPUTS)
def test_any_leading_axes(branches, module):
    apply, variables = branches[module]
    alone = apply(variables, *INPUTS[module])
    pairs = jax.tree.map(lambda x: jnp.stack([x, x]), INPUTS[module])
    together = apply(variables, *pairs)
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a[1], b, atol=1e-5)
