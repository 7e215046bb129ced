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
from prism_jax.models.encoder import PointFeatures

CONFIG = AuxiliaryConfig(num_tokens=4, token_features=8, hidden=8)
RNG = np.random.default_rng(0)


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


NO_NEIGHBORS = np.zeros((12, 4), np.int32)
ENCODED = PointFeatures(normal(12, 3), normal(12, 5), normal(6), NO_NEIGHBORS)
POINTS, FEATURES = normal(20, 3), normal(20, 7)
NEIGHBORS = jnp.asarray(RNG.integers(0, 20, (20, 4)))
INPUTS = {
    TokenIntegrator: (ENCODED,),
    DepthProjection: (normal(9, 5),),
    NormalHead: (POINTS, FEATURES),
    Denoiser: (POINTS, NEIGHBORS, normal(8)),
}


@pytest.fixture(scope="module")
def branches():
    """``{module: (its compiled apply, its variables)}``."""
    out = {}
    for module, inputs in INPUTS.items():
        variables = jax.jit(module(CONFIG).init)(jax.random.key(1), *inputs)
        out[module] = jax.jit(module(CONFIG).apply), variables
    return out


def test_normals_have_unit_length(branches):
    apply, variables = branches[NormalHead]
    normals = apply(variables, POINTS, FEATURES)
    assert normals.shape == (20, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-4)
    # A head that returns zero can still learn.
    zeros = jax.tree.map(jnp.zeros_like, variables)
    gradient = jax.jit(jax.grad(lambda v: apply(v, POINTS, FEATURES).sum()))(zeros)
    assert 0 < max(np.abs(leaf).max() for leaf in jax.tree.leaves(gradient)) < np.inf


def test_tokens_of_both_streams_are_normalised(branches):
    """Without parameters: their scale cannot run away, or shrink to nothing."""
    apply, variables = branches[TokenIntegrator]
    integrated, latent = apply(variables, ENCODED)
    apply, variables = branches[DepthProjection]
    projected = apply(variables, *INPUTS[DepthProjection])
    assert latent.shape == (8,)
    for tokens, count in ((integrated, 4), (projected, 9)):
        assert tokens.shape == (count, 8)
        np.testing.assert_allclose(tokens.mean(-1), 0, atol=1e-6)
        np.testing.assert_allclose(tokens.std(-1), 1, atol=1e-3)


def test_offsets_start_small_and_look_at_neighbours_only(branches):
    apply, variables = branches[Denoiser]
    _, neighbors, latent = INPUTS[Denoiser]
    offsets = np.asarray(apply(variables, POINTS, neighbors, latent))
    assert 0 < np.abs(offsets).max() < 0.2
    moved = apply(variables, POINTS.at[7].add(1.0), neighbors, latent)
    touched = (np.asarray(neighbors) == 7).any(-1) | (np.arange(20) == 7)
    changed = (np.asarray(moved) != offsets).any(-1)
    assert changed[touched].any()
    assert not changed[~touched].any()


@pytest.mark.parametrize("module", INPUTS)
def test_leading_axes_and_gradients_of_inputs_that_are_all_zero(branches, module):
    apply, variables = branches[module]
    pairs = jax.tree.map(lambda x: jnp.stack([x, 0 * x]), INPUTS[module])

    def loss(variables, inputs):
        outputs = apply(variables, *inputs)
        return sum((leaf[1] ** 2).sum() for leaf in jax.tree.leaves(outputs)), outputs

    gradient = jax.grad(loss, argnums=(0, 1), allow_int=True, has_aux=True)
    grads, together = jax.jit(gradient)(variables, pairs)
    grads = [g for g in jax.tree.leaves(grads) if g.dtype != jax.dtypes.float0]
    assert len(grads) > len(jax.tree.leaves(variables))
    assert all(np.isfinite(leaf).all() for leaf in grads)
    alone = apply(variables, *INPUTS[module])
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a[0], b, atol=1e-5)
