"""How far a child can lie from its parent."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.models.backbone import decode, encode_points, partial_indices
from prism_jax.models.layers import take


def test_children_lie_within_reach_of_their_parents(
    minimal, minimal_fresh, tiny_frames, quick_jit
):
    """Far offsets come to it, and small ones are left alone."""
    reach, wanted = 0.05, np.float32([1e3, -0.02, 1e-4])
    backbone = dataclasses.replace(minimal.model.backbone, offset_reach=reach)
    variables = jax.tree.map(np.asarray, minimal_fresh)
    last = variables["params"]["decoder"]["block_0"]["offset"]["dense_1"]
    last |= {"kernel": 0 * last["kernel"], "bias": wanted}
    partials, _ = tiny_frames

    @quick_jit
    def decoded(variables, partials):
        indices = partial_indices(partials, backbone)
        encoded = encode_points(variables, backbone, partials, indices)
        return decode(variables, backbone, partials, encoded)

    found = decoded(variables, partials)
    joined = jnp.concatenate([found.stages[0], partials], axis=-2)
    parents = take(joined, found.indices.initial)
    (children,) = found.stages[1:]
    parents = np.repeat(parents, children.shape[-2] // parents.shape[-2], axis=-2)
    expected = np.broadcast_to(reach * np.tanh(wanted / reach), children.shape)
    np.testing.assert_allclose(children - parents, expected, atol=1e-6)
