"""How far a child can lie from its parent."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.models.backbone import decode, encode_points, partial_indices
from prism_jax.models.layers import take


@pytest.fixture(scope="module")
def strewn(minimal_fresh):
    """Variables of `minimal` whose offsets know no measure."""
    params = minimal_fresh["params"]
    blocks = {
        name: {
            **block,
            "offset": jax.tree.map(lambda leaf: 1e3 * leaf, block["offset"]),
        }
        for name, block in params["decoder"].items()
        if name.startswith("block")
    }
    params = {**params, "decoder": {**params["decoder"], **blocks}}
    return {**minimal_fresh, "params": params}


def decoded(variables, backbone, partial):
    indices = partial_indices(partial, backbone)
    encoded = encode_points(variables, backbone, partial, indices)
    return decode(variables, backbone, partial, encoded)


def test_children_lie_within_reach_of_their_parents(
    minimal, strewn, tiny_frames, quick_jit
):
    reach = 0.05
    backbone = dataclasses.replace(minimal.model.backbone, offset_reach=reach)
    partials, _ = tiny_frames
    found = quick_jit(lambda cloud: decoded(strewn, backbone, cloud))(partials)
    joined = jnp.concatenate([found.stages[0], partials], axis=-2)
    parents = take(joined, found.indices.initial)
    for children in found.stages[1:]:
        times = children.shape[-2] // parents.shape[-2]
        apart = np.abs(children - np.repeat(parents, times, axis=-2))
        assert 0.9 * reach < apart.max() <= reach * (1 + 1e-5)
        parents = children


@pytest.fixture(scope="module")
def last(minimal, tiny_frames):
    """``last(variables, reach)``: the last stage."""

    def last(variables, reach):
        backbone = dataclasses.replace(minimal.model.backbone, offset_reach=reach)
        return decoded(variables, backbone, tiny_frames[0][0]).stages[-1]

    return last


def test_small_offsets_are_left_alone(last, minimal_fresh, quick_jit):
    """So a training goes on from weights that could reach farther."""
    both = quick_jit(lambda variables: [last(variables, reach) for reach in (0.5, 1.0)])
    np.testing.assert_allclose(*both(minimal_fresh), atol=1e-3)


@pytest.mark.slow
def test_gradients_are_finite(last, minimal_fresh, quick_jit):
    slope = quick_jit(jax.grad(lambda variables: jnp.sum(last(variables, 0.5) ** 2)))
    assert all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope(minimal_fresh))
    )
