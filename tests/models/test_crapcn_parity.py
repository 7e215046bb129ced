"""Every stage of the network against the reference's arrays.

Each stage gets the reference's inputs and is compared with the reference's output, so
that a neighbour that changes by rounding cannot hide or excuse a fault elsewhere.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.neighbors import knn
from prism_jax.models.attention import Cloud
from prism_jax.models.decoder import SeedGenerator, UpsamplingBlock
from prism_jax.models.encoder import PointEncoder, PointFeatures, encoder_indices
from prism_jax.models.layers import over_batch, take
from prism_jax.models.pyramid import build_pyramid, sampled_rows

FEATURES, COORDINATES = 2e-5, 2e-6


def assert_within(actual, expected, tolerance):
    assert actual.shape == expected.shape
    assert np.abs(np.asarray(actual) - expected).max() <= tolerance


def test_encoder(published):
    pcn = published("pcn")
    config, ref, cloud = pcn.config, pcn.ref, pcn.arrays["input"]

    @jax.jit
    def run(variables, partial):
        indices = encoder_indices(partial, config)
        encoded = PointEncoder(config).apply(variables, partial, indices)
        return indices.neighbors[0], encoded

    neighbors, encoded = run(pcn.subtree("point_encoder"), cloud)
    assert_within(encoded.patch_xyz, ref("enc_l2_xyz"), 0)
    assert_within(encoded.patch_features, ref("enc_l2_feat"), FEATURES)
    assert_within(encoded.global_feature[:, None], ref("global_feat"), FEATURES)
    expected = pcn.arrays["ref/enc_l1_knn"]
    # Points repeat in the cloud, so neighbours are compared by where they are.
    for points, ours, theirs in zip(cloud, neighbors, expected, strict=True):
        for a, b in zip(points[ours], points[theirs], strict=True):
            np.testing.assert_array_equal(a[np.lexsort(a.T)], b[np.lexsort(b.T)])


def test_seed_generator(published):
    pcn = published("pcn")
    config = pcn.config

    @jax.jit
    def run(variables, encoded, partial):
        made = SeedGenerator(config).apply(variables, encoded)
        expected = jnp.asarray(pcn.ref("seed"))
        joined = jnp.concatenate([expected, partial], axis=-2)
        initial = take(joined, sampled_rows(joined, config.num_initial))
        return *made, initial

    patches = pcn.ref("enc_l2_xyz")
    search = over_batch(lambda xyz: knn(xyz, xyz, config.patch_neighbors))
    encoded = PointFeatures(
        patches,
        pcn.ref("enc_l2_feat"),
        pcn.ref("global_feat")[:, 0],
        search(jnp.asarray(patches)),
    )
    variables = pcn.subtree("decoder", "seed_generator")
    seeds, features, initial = run(variables, encoded, pcn.arrays["input"])
    assert_within(seeds, pcn.ref("seed"), COORDINATES)
    assert_within(features, pcn.ref("seed_feat"), FEATURES)
    assert_within(initial, pcn.ref("p0"), 0)


BLOCK_INPUTS = (
    ("p0", "seed", "seed_feat"),
    ("ub0_xyz", "p0", "ub0_feat"),
    ("ub1_xyz", "ub0_xyz", "ub1_feat"),
)


# Up to the last block, the arrays of the two variants are the same.
@pytest.mark.parametrize(
    ("variant", "number"),
    [*(pytest.param("pcn", i, marks=pytest.mark.slow) for i in range(3)), ("sn55", 2)],
)
def test_upsampling_block(published, variant, number):
    network = published(variant)
    config = network.config
    rates, times = config.level_rates[number], config.up_factors[number]

    def pyramid_of(query, support):
        clouds = query, support
        orders = (sampled_rows(c, len(c) // rates[1]) for c in clouds)
        return build_pyramid(*clouds, *orders, rates, config.num_neighbors)

    @jax.jit
    def run(variables, xyz, global_feature, support_xyz, support_features):
        inter = over_batch(pyramid_of)(xyz, support_xyz)
        intra = over_batch(pyramid_of)(xyz, xyz)
        support = Cloud(support_xyz, support_features)
        inputs = (xyz, global_feature, support, inter, intra)
        return UpsamplingBlock(config, times).apply(variables, *inputs)

    xyz, *support = (network.ref(name) for name in BLOCK_INPUTS[number])
    children, features, _ = run(
        network.subtree("decoder", f"block_{number}"),
        xyz,
        network.ref("global_feat")[:, 0],
        *support,
    )
    assert children.shape[1] == xyz.shape[1] * times
    assert_within(children, network.ref(f"ub{number}_xyz"), COORDINATES)
    assert_within(features, network.ref(f"ub{number}_feat"), FEATURES)
