"""The decoder: seeds, then up-sampling blocks from coarse to fine."""

import functools
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from prism_jax.geometry.visibility import Visibility, visibility_features
from prism_jax.models import attention, pyramid
from prism_jax.models.config import BackboneConfig
from prism_jax.models.encoder import PointFeatures
from prism_jax.models.layers import (
    MLP,
    Dense,
    ResidualMLP,
    SplitPoints,
    batch_norm,
    highest,
    over_batch,
    repeat_in_place,
    take,
)

_ALONG = np.linspace(-1.5, 1.5, 7)
# Where the seeds read visibility: points in and around the workspace.
_LATTICE = np.stack(np.meshgrid(_ALONG, _ALONG, _ALONG), -1).reshape(-1, 3)


class DecoderIndices(NamedTuple):
    """The samples and neighbours of one decoding, without a derivative."""

    # Rows of the seeds and the partial, joined, that the blocks start from.
    initial: Int[Array, "... n"]
    # Of every block, between the levels and within its own.
    pyramids: tuple[tuple[pyramid.Pyramid, pyramid.Pyramid], ...]


class Decoded(NamedTuple):
    """Every stage's points, seeds first, the last stage's per-point features, and the
    indices that led to them."""

    stages: tuple[Float[Array, "... N 3"], ...]
    features: Float[Array, "... N C"]
    indices: DecoderIndices


class SeedGenerator(nn.Module):
    """Coarse complete points from the patches and the global feature."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self, encoded: PointFeatures, train: bool = False
    ) -> tuple[Float[Array, "... S 3"], Float[Array, "... S C"]]:
        config = self.config
        width = config.features
        patches = attention.Cloud(encoded.patch_xyz, encoded.patch_features)
        upsample = attention.UpsamplingAttention(config, name="upsample")
        x = upsample(patches, encoded.patch_neighbors, train)
        context = encoded.global_feature[..., None, :]
        x = ResidualMLP(width, width, name="mlp_1")(x, context)
        x = ResidualMLP(width // 2, width, name="mlp_2")(x)
        x = ResidualMLP(width, width, name="mlp_3")(x, context)
        seeds = MLP((width // 2, 3), name="coordinates")(x)
        if config.seeds_from_patches:
            seeds = seeds + repeat_in_place(encoded.patch_xyz, config.seed_times)
        return seeds, x


class VisibilityPooling(nn.Module):
    """One feature of the visibility: what it says at a lattice of points, a shared MLP,
    the maximum. Zero at first, so that training can go on from weights without it."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self, partial: Float[Array, "... N 3"], visibility: Visibility
    ) -> Float[Array, "... G"]:
        at = jnp.asarray(_LATTICE, partial.dtype)
        at_lattice = over_batch(lambda _, known: visibility_features(known, at))
        found = at_lattice(partial, visibility)
        at = jnp.broadcast_to(at, (*found.shape[:-1], 3))
        width = self.config.features
        each = MLP((width, width), name="point")(jnp.concatenate([at, found], axis=-1))
        out = MLP((self.config.global_features[-1],), nn.initializers.zeros, name="out")
        return out(nn.relu(highest(each))[..., None, :])[..., 0, :]


class UpsamplingBlock(nn.Module):
    """Inter-level and intra-level transformers, and children with bounded offsets."""

    config: BackboneConfig
    times: int

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        global_feature: Float[Array, "... G"],
        support: attention.Cloud,
        inter: pyramid.Pyramid,
        intra: pyramid.Pyramid,
        train: bool = False,
        visibility: Visibility | None = None,
    ) -> tuple[Float[Array, "... M 3"], Float[Array, "... N C"], Array]:
        x = self._point_features(xyz, global_feature, visibility)
        own = attention.Cloud(xyz, x)
        transformer = attention.CrossResolutionTransformer(self.config, name="inter")
        own = own._replace(features=transformer(own, support, inter, train))
        transformer = attention.CrossResolutionTransformer(self.config, name="intra")
        x = transformer(own, own, intra, train)
        offsets, child_features = self._children(x, train)
        return repeat_in_place(xyz, self.times) + offsets, x, child_features

    def _point_features(
        self, xyz: Array, global_feature: Array, visibility: Visibility | None
    ) -> Array:
        width = self.config.features
        x = MLP((width // 2, width), name="point_0")(xyz)
        if self.config.reads_visibility:
            read = over_batch(lambda cloud, known: visibility_features(known, cloud))
            # Zero at first, so that training can go on from weights without it.
            zeros = nn.initializers.zeros
            reading = MLP((width // 2, width), zeros, name="clues")
            x = x + reading(read(xyz, visibility))
        whole = highest(x)[..., None, :]
        mlp = MLP((4 * width, 2 * width, width), name="point_1")
        return mlp(x, whole, global_feature[..., None, :])

    def _children(self, x: Array, train: bool) -> tuple[Array, Array]:
        width = self.config.features
        reduced = Dense(width // 2, name="reduce_0")(x)
        if self.config.use_norm:
            reduced = batch_norm(train)(reduced)
        reduced = Dense(width // 4, name="reduce_1")(nn.relu(reduced))
        child = SplitPoints(width, self.times, use_bias=False, name="split")(reduced)
        child = ResidualMLP(width, width, name="child")(child, x)
        init = nn.initializers.normal(self.config.offset_init)
        offsets = MLP((width // 2, 3), final_init=init, name="offset")(nn.relu(child))
        reach = self.config.offset_reach
        return reach * jnp.tanh(offsets / reach), child


class Decoder(nn.Module):
    """CRA-PCN's decoder, from the encoded partial to every stage's points.

    It stops after ``num_blocks``, if that is given. With the ``indices`` of another
    decoding, whose points are near, the stages are a continuous function of what is
    encoded. ``visibility`` is for configurations that read it.
    """

    config: BackboneConfig

    @nn.compact
    def __call__(
        self,
        partial: Float[Array, "... N 3"],
        encoded: PointFeatures,
        train: bool = False,
        num_blocks: int | None = None,
        indices: DecoderIndices | None = None,
        visibility: Visibility | None = None,
    ) -> Decoded:
        config = self.config
        if config.reads_visibility and visibility is None:
            raise ValueError("a decoder that reads visibility needs a map")
        if config.seeds_read_visibility and visibility is not None:
            pooled = VisibilityPooling(config, name="visibility_pooling")
            whole = encoded.global_feature + pooled(partial, visibility)
            encoded = encoded._replace(global_feature=whole)
        seeds, features = SeedGenerator(config, name="seed_generator")(encoded, train)
        joined = jnp.concatenate([seeds, partial], axis=-2)
        if indices is None:
            initial = pyramid.sampled_rows(joined, config.num_initial)
            order = jnp.broadcast_to(jnp.arange(config.num_initial), initial.shape)
            support_order = pyramid.sampled_rows(seeds, seeds.shape[-2] // 2)
        else:
            initial = indices.initial
        stages, pyramids = [seeds], []
        previous, xyz = attention.Cloud(seeds, features), take(joined, initial)
        blocks = list(zip(config.up_factors, config.level_rates, strict=True))
        for i, (times, rates) in enumerate(blocks[:num_blocks]):
            if indices is None:
                if i:
                    half = xyz.shape[-2] // 2
                    support_order, order = order, pyramid.sampled_rows(xyz, half)
                levels = rates, config.num_neighbors
                build = over_batch(functools.partial(_pyramids, levels=levels))
                pair = build(xyz, order, previous.xyz, support_order)
            else:
                pair = indices.pyramids[i]
            pyramids.append(pair)
            block = UpsamplingBlock(config, times, name=f"block_{i}")
            children, block_features, features = block(
                xyz, encoded.global_feature, previous, *pair, train, visibility
            )
            previous, xyz = attention.Cloud(xyz, block_features), children
            stages.append(xyz)
        return Decoded(tuple(stages), features, DecoderIndices(initial, (*pyramids,)))


def _pyramids(
    xyz: Array,
    order: Array,
    support: Array,
    support_order: Array,
    levels: tuple[tuple[int, ...], tuple[int, ...]],
) -> tuple[pyramid.Pyramid, pyramid.Pyramid]:
    """Of one cloud, to what it looks at and within itself."""
    xyz, support = jax.lax.stop_gradient((xyz, support))
    inter = pyramid.build_pyramid(xyz, support, order, support_order, *levels)
    return inter, pyramid.build_pyramid(xyz, xyz, order, order, *levels)
