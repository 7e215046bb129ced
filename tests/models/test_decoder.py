"""How the decoder's blocks follow each other, with stand-ins for their layers.

`test_crapcn_parity.py` has the blocks themselves, and, marked slow, all of them.
"""

import itertools

import flax.linen as nn
import jax.numpy as jnp
import numpy as np

from prism_jax.models import decoder
from prism_jax.models.encoder import PointFeatures
from prism_jax.models.layers import repeat_in_place


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
            given.append((self.name, xyz, whole, support, inter, intra))
            number = len(given)
            children = repeat_in_place(xyz, self.times) + 0.01 * number
            return children, xyz + 10.0 * number, children

    monkeypatch.setattr(decoder, "SeedGenerator", Seeds)
    monkeypatch.setattr(decoder, "UpsamplingBlock", Block)
    encoded = PointFeatures(None, None, code, None)
    made = decoder.Decoder(config).apply({}, partial, encoded)
    first = jnp.concatenate([seeds, partial])[made.indices.initial]
    assert len(given) == len(config.up_factors) >= 2
    assert [name for name, *_ in given] == [f"block_{i}" for i in range(len(given))]
    np.testing.assert_array_equal(given[0][1], first)
    np.testing.assert_array_equal(given[0][3].xyz, seeds)
    np.testing.assert_array_equal(given[0][3].features, seeds + 1.0)
    for number, (one, another) in enumerate(itertools.pairwise(given), start=1):
        (_, before, *_), (_, xyz, whole, support, *pair) = one, another
        np.testing.assert_array_equal(xyz, made.stages[number])
        np.testing.assert_array_equal(whole, code)
        np.testing.assert_array_equal(support.xyz, before)
        np.testing.assert_array_equal(support.features, before + 10.0 * number)
        assert pair[0] is made.indices.pyramids[number][0]
        assert pair[1] is made.indices.pyramids[number][1]
    np.testing.assert_array_equal(made.stages[0], seeds)
    assert made.stages[-1].shape == (config.stage_sizes[-1], 3)
