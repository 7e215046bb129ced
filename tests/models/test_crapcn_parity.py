"""Every stage of the network against the reference's arrays.

Each stage gets the reference's inputs and is compared with the reference's output, so
that a neighbour that changes by rounding cannot hide or excuse a fault elsewhere.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.neighbors import knn
from prism_jax.models.attention import CrossResolutionTransformer
from prism_jax.models.decoder import (
    Cloud,
    SeedGenerator,
    UpsamplingBlock,
    sampled_rows,
)
from prism_jax.models.encoder import PointEncoder, PointFeatures, encoder_indices
from prism_jax.models.layers import over_batch, take
from prism_jax.models.pyramid import build_pyramid, farthest_order, resolution_rows

FEATURES, COORDINATES = 2e-5, 2e-6


def assert_within(actual, expected, tolerance):
    assert actual.shape == expected.shape
    assert np.abs(np.asarray(actual) - expected).max() <= tolerance


def apply_captured(module, variables, *inputs):
    """The module's output, and those of its submodules by their path."""
    output, captured = module.apply(
        variables, *inputs, capture_intermediates=True, mutable=["intermediates"]
    )

    def submodule(path):
        tree = captured["intermediates"]
        for name in path.split("/"):
            tree = tree[name]
        return tree["__call__"][0]

    return output, submodule


ENCODER_LEVELS = [
    f"transformer_1/{part}"
    for part in (
        *("attention_2", "attention_1", "attention_0", "attention_2/position_1"),
        *("query_1", "support_1", "query_0", "support_0"),
    )
]


@pytest.fixture(scope="module")
def encoder(published):
    """The whole encoder: its output and what its parts made on the way."""
    pcn = published("pcn")
    config = pcn.config

    @jax.jit
    def run(variables, partial):
        indices = over_batch(lambda cloud: encoder_indices(cloud, config))(partial)
        encoded, submodule = apply_captured(
            PointEncoder(config), variables, partial, indices
        )
        parts = ["abstraction_1", "transformer_1", "abstraction_2", *ENCODER_LEVELS]
        return indices, encoded, {part: submodule(part) for part in parts}

    return run(pcn.subtree("point_encoder"), pcn.arrays["input"])


def test_encoder_stages(published, encoder):
    ref, (_, encoded, parts) = published("pcn").ref, encoder
    assert_within(parts["abstraction_1"], ref("enc_l1_sa"), FEATURES)
    assert_within(parts["transformer_1"], ref("enc_l1_feat"), FEATURES)
    assert_within(parts["abstraction_2"], ref("enc_l2_sa"), FEATURES)
    assert_within(encoded.patch_xyz, ref("enc_l2_xyz"), 0)
    assert_within(encoded.patch_features, ref("enc_l2_feat"), FEATURES)
    assert_within(encoded.global_feature[:, None], ref("global_feat"), FEATURES)


def test_encoder_finds_the_same_neighbours(published, encoder):
    pcn = published("pcn")
    indices = np.asarray(encoder[0].neighbors[0])
    for cloud, found, expected in zip(
        pcn.arrays["input"], indices, pcn.arrays["ref/enc_l1_knn"], strict=True
    ):
        # Points repeat in the cloud, so neighbours are compared by where they are.
        for ours, theirs in zip(cloud[found], cloud[expected], strict=True):
            np.testing.assert_array_equal(sort_rows(ours), sort_rows(theirs))


def sort_rows(points):
    return points[np.lexsort(points.T)]


def check_levels(arrays, parts):
    """The inner levels of a cross-resolution block."""
    for level in (2, 1, 0):
        names = {"attention": "out"}
        if level < 2:
            names |= {"query": "query_feat", "support": "support_feat"}
        for part, name in names.items():
            expected = arrays(f"level{level}_{name}").swapaxes(1, 2)
            assert_within(parts(f"{part}_{level}"), expected, FEATURES)
    # The order of the neighbours is free.
    embedding = np.asarray(parts("attention_2/position_1"))[:1, ..., :8]
    expected = arrays("level2_pos_embed").transpose(0, 2, 3, 1)
    assert_within(np.sort(embedding, -2), np.sort(expected, -2), FEATURES)


def test_inner_levels_of_an_intra_level_block(published, encoder):
    arrays, parts = published("pcn").arrays, encoder[2]
    check_levels(
        lambda name: arrays[f"crt1/{name}"], lambda part: parts[f"transformer_1/{part}"]
    )


def pyramid_of(query, support, rates, config):
    def build(q, s):
        order_q = farthest_order(q, len(q) // rates[1])
        order_s = farthest_order(s, len(s) // rates[1])
        rows_q = resolution_rows(order_q, len(q), rates)
        rows_s = resolution_rows(order_s, len(s), rates)
        return build_pyramid(q, s, rows_q, rows_s, config.num_neighbors)

    return over_batch(build)(query, support)


def test_inner_levels_of_an_inter_level_block(published):
    pcn = published("pcn")
    config, arrays = pcn.config, pcn.arrays
    transformer = CrossResolutionTransformer(config)

    @jax.jit
    def run(variables, *clouds):
        pyramid = pyramid_of(clouds[0], clouds[2], (1, 2, 4), config)
        _, captured = transformer.apply(
            variables,
            *clouds,
            pyramid,
            capture_intermediates=True,
            mutable=["intermediates"],
        )
        return captured["intermediates"]

    clouds = [pcn.ref(name) for name in ("p0", "ub0_pn", "seed", "seed_feat")]
    captured = run(pcn.subtree("decoder", "block_0", "inter"), *clouds)

    def part(path):
        tree = captured
        for name in path.split("/"):
            tree = tree[name]
        return tree["__call__"][0]

    check_levels(lambda name: arrays[f"ub0_inter/{name}"], part)
    assert_within(captured["__call__"][0], pcn.ref("ub0_inter"), FEATURES)


def test_seed_generator(published):
    pcn = published("pcn")
    config = pcn.config

    @jax.jit
    def run(variables, encoded, partial):
        (seeds, features), submodule = apply_captured(
            SeedGenerator(config), variables, encoded
        )
        expected = jnp.asarray(pcn.ref("seed"))
        joined = jnp.concatenate([expected, partial], axis=-2)
        initial = take(joined, sampled_rows(joined, config.num_initial))
        return seeds, features, submodule("upsample"), initial

    patches = pcn.ref("enc_l2_xyz")
    search = over_batch(lambda xyz: knn(xyz, xyz, config.patch_neighbors))
    encoded = PointFeatures(
        patches,
        pcn.ref("enc_l2_feat"),
        pcn.ref("global_feat")[:, 0],
        search(jnp.asarray(patches)),
    )
    variables = pcn.subtree("decoder", "seed_generator")
    seeds, features, raised, initial = run(variables, encoded, pcn.arrays["input"])
    assert_within(raised, pcn.ref("sg_up"), FEATURES)
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
    ("variant", "number"), [("pcn", 0), ("pcn", 1), ("pcn", 2), ("sn55", 2)]
)
def test_upsampling_block(published, variant, number):
    network = published(variant)
    config = network.config
    rates, times = config.level_rates[number], config.up_factors[number]

    @jax.jit
    def run(variables, xyz, global_feature, support_xyz, support_features):
        inter = pyramid_of(xyz, support_xyz, rates, config)
        intra = pyramid_of(xyz, xyz, rates, config)
        support = Cloud(support_xyz, support_features)
        inputs = (xyz, global_feature, support, inter, intra)
        block = UpsamplingBlock(config, times)
        output, submodule = apply_captured(block, variables, *inputs)
        return output[:2], submodule("point_1"), submodule("inter")

    xyz, *support = (network.ref(name) for name in BLOCK_INPUTS[number])
    (children, features), point, inter = run(
        network.subtree("decoder", f"block_{number}"),
        xyz,
        network.ref("global_feat")[:, 0],
        *support,
    )
    assert children.shape[1] == xyz.shape[1] * times
    assert_within(children, network.ref(f"ub{number}_xyz"), COORDINATES)
    assert_within(features, network.ref(f"ub{number}_feat"), FEATURES)
    assert_within(point, network.ref(f"ub{number}_pn"), FEATURES)
    assert_within(inter, network.ref(f"ub{number}_inter"), FEATURES)


# Of the other variant `test_crapcn_gradients.py`, as slow, asks the same.
@pytest.mark.slow
def test_end_to_end(published, run_backbone):
    network = published("sn55")
    stages = run_backbone(network.config, network.variables, network.arrays["input"])
    network.check_end_to_end(stages)


@pytest.mark.parametrize("name", ["input", "seed", "seed_plus_input", "p1", "p2"])
def test_farthest_point_orders(published, name):
    pcn = published("pcn")
    clouds = cloud_named(pcn, name)
    expected = pcn.arrays[f"fps/{name}/idx_lowest_ties"]
    order = jax.jit(over_batch(lambda c: farthest_order(c, expected.shape[1])))(clouds)
    np.testing.assert_array_equal(order, expected)
    ties_of_cuda = pcn.arrays[f"fps/{name}/idx_cuda_ties"]
    for cloud, ours, theirs in zip(clouds, order, ties_of_cuda, strict=True):
        np.testing.assert_array_equal(cloud[ours], cloud[theirs])


@pytest.mark.parametrize("name", ["enc_l1_xyz", "enc_l2_xyz", "p0"])
def test_a_sampled_cloud_is_in_farthest_point_order(published, name):
    """What lets the encoder and the first block slice instead of sampling again."""
    pcn = published("pcn")
    for kind in ("lowest", "cuda"):
        order = pcn.arrays[f"fps/{name}/idx_{kind}_ties"]
        for cloud, indices in zip(cloud_named(pcn, name), order, strict=True):
            np.testing.assert_array_equal(cloud[indices], cloud[: len(indices)])


def cloud_named(network, name):
    if name == "input":
        return network.arrays["input"]
    if name == "seed_plus_input":
        return np.concatenate([network.ref("seed"), network.arrays["input"]], 1)
    return network.ref({"p1": "ub0_xyz", "p2": "ub1_xyz"}.get(name, name))
