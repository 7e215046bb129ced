"""How the decoder's blocks follow each other, and how far a child can lie away."""

import dataclasses
import itertools

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.models import decoder
from prism_jax.models.backbone import decode, encode_points
from prism_jax.models.encoder import PointFeatures
from prism_jax.models.layers import repeat_in_place, take


def test_each_block_is_supported_by_the_points_before_it(monkeypatch, tiny):
    config, rng = tiny.model.backbone, np.random.default_rng(0)
    seeds = jnp.float32(rng.uniform(-1, 1, (32, 3)))
    partial = jnp.float32(rng.uniform(-1, 1, (config.num_points, 3)))
    code = jnp.float32(rng.normal(size=config.global_features[-1]))
    given = []

    class Seeds(nn.Module):
        config: object

        def __call__(self, encoded, train):
            return seeds, seeds + 1.0

    class Block(nn.Module):
        config: object
        times: int

        def __call__(self, xyz, whole, support, inter, intra, train, visibility):
            assert self.name == f"block_{len(given)}"
            given.append((xyz, whole, support, inter, intra))
            number = len(given)
            children = repeat_in_place(xyz, self.times) + 0.01 * number
            return children, xyz + 10.0 * number, children

    monkeypatch.setattr(decoder, "SeedGenerator", Seeds)
    monkeypatch.setattr(decoder, "UpsamplingBlock", Block)
    encoded = PointFeatures(None, None, code, None)

    @jax.jit
    def run():
        made = decoder.Decoder(config).apply({}, partial, encoded)
        return made, given

    made, given = run()
    assert len(given) == len(config.up_factors) >= 2
    xyz, _, support, *_ = given[0]
    first = jnp.concatenate([seeds, partial])[made.indices.initial]
    np.testing.assert_array_equal(xyz, first)
    np.testing.assert_array_equal(support.xyz, seeds)
    np.testing.assert_array_equal(support.features, seeds + 1.0)
    for number, (one, another) in enumerate(itertools.pairwise(given), start=1):
        (before, *_), (xyz, whole, support, *pyramids) = one, another
        np.testing.assert_array_equal(xyz, made.stages[number])
        np.testing.assert_array_equal(whole, code)
        np.testing.assert_array_equal(support.xyz, before)
        np.testing.assert_allclose(support.features, before + 10.0 * number)
        chex.assert_trees_all_equal(tuple(pyramids), made.indices.pyramids[number])
    np.testing.assert_array_equal(made.stages[0], seeds)
    assert made.stages[-1].shape == (config.stage_sizes[-1], 3)


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
        encoded = encode_points(variables, backbone, partials)
        return decode(variables, backbone, partials, encoded)

    found = decoded(variables, partials)
    joined = jnp.concatenate([found.stages[0], partials], axis=-2)
    parents = take(joined, found.indices.initial)
    (children,) = found.stages[1:]
    parents = np.repeat(parents, children.shape[-2] // parents.shape[-2], axis=-2)
    expected = np.broadcast_to(reach * np.tanh(wanted / reach), children.shape)
    np.testing.assert_allclose(children - parents, expected, atol=1e-6)
