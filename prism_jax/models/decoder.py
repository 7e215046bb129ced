"""The decoder: seeds, then up-sampling blocks from coarse to fine."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.models.attention import CrossResolutionTransformer, UpsamplingAttention
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
)
from prism_jax.models.pyramid import (
    Pyramid,
    build_pyramid,
    farthest_order,
    resolution_rows,
)


class Decoded(NamedTuple):
    """Every stage's points, seeds first, and the last stage's per-point features."""

    stages: tuple[Float[Array, "... N 3"], ...]
    features: Float[Array, "... N C"]


class Cloud(NamedTuple):
    """A stage's points, their features, and their farthest-point order."""

    xyz: Float[Array, "... N 3"]
    features: Float[Array, "... N C"]
    order: Int[Array, "... n"]


class SeedGenerator(nn.Module):
    """Coarse complete points from the patches and the global feature."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self, encoded: PointFeatures, train: bool = False
    ) -> tuple[Float[Array, "... S 3"], Float[Array, "... S C"]]:
        config = self.config
        width = config.features
        x = UpsamplingAttention(
            width,
            config.attention_features,
            config.attention_ratio,
            config.seed_times,
            config.use_norm,
            name="upsample",
        )(encoded.patch_xyz, encoded.patch_features, encoded.patch_neighbors, train)
        context = encoded.global_feature[..., None, :]
        x = ResidualMLP(width, width, name="mlp_1")(x, context)
        x = ResidualMLP(width // 2, width, name="mlp_2")(x)
        x = ResidualMLP(width, width, name="mlp_3")(x, context)
        seeds = MLP((width // 2, 3), name="coordinates")(x)
        if config.seeds_from_patches:
            seeds = seeds + repeat_in_place(encoded.patch_xyz, config.seed_times)
        return seeds, x


class UpsamplingBlock(nn.Module):
    """Inter-level and intra-level transformers, and children with bounded offsets."""

    config: BackboneConfig
    times: int

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        global_feature: Float[Array, "... G"],
        support: Cloud,
        inter: Pyramid,
        intra: Pyramid,
        train: bool = False,
    ) -> tuple[Float[Array, "... M 3"], Float[Array, "... N C"], Array]:
        x = self._point_features(xyz, global_feature)
        transformer = self._transformer("inter")
        x = transformer(xyz, x, support.xyz, support.features, inter, train)
        x = self._transformer("intra")(xyz, x, xyz, x, intra, train)
        offsets, child_features = self._children(x, train)
        return repeat_in_place(xyz, self.times) + offsets, x, child_features

    def _point_features(self, xyz: Array, global_feature: Array) -> Array:
        width = self.config.features
        x = MLP((width // 2, width), name="point_0")(xyz)
        whole = highest(x)[..., None, :]
        mlp = MLP((4 * width, 2 * width, width), name="point_1")
        return mlp(x, whole, global_feature[..., None, :])

    def _transformer(self, name: str) -> CrossResolutionTransformer:
        return CrossResolutionTransformer(
            self.config.features,
            self.config.attention_features,
            self.config.attention_ratio,
            self.config.use_norm,
            name=name,
        )

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
        return jnp.tanh(offsets), child


class Decoder(nn.Module):
    """CRA-PCN's decoder, from the encoded partial to every stage's points.

    ``num_blocks`` stops after so many up-sampling blocks, for training coarse stages
    first; the default is all.
    """

    config: BackboneConfig

    @nn.compact
    def __call__(
        self,
        partial: Float[Array, "... N 3"],
        encoded: PointFeatures,
        train: bool = False,
        num_blocks: int | None = None,
    ) -> Decoded:
        config = self.config
        seeds, seed_features = SeedGenerator(config, name="seed_generator")(
            encoded, train
        )
        previous = _cloud(seeds, seed_features)
        features = seed_features
        stages = [seeds]
        xyz = over_batch(lambda s, p: initial_points(s, p, config.num_initial))(
            seeds, partial
        )
        order = jnp.broadcast_to(jnp.arange(xyz.shape[-2]), xyz.shape[:-1])
        blocks = list(zip(config.up_factors, config.level_rates, strict=True))
        for i, (times, rates) in enumerate(blocks[:num_blocks]):
            inter, intra = _pyramids(xyz, order, previous, rates, config.num_neighbors)
            block = UpsamplingBlock(config, times, name=f"block_{i}")
            children, block_features, features = block(
                xyz, encoded.global_feature, previous, inter, intra, train
            )
            previous = Cloud(xyz, block_features, order)
            xyz = children
            stages.append(xyz)
            if i + 1 < len(blocks[:num_blocks]):
                order = _order(xyz)
        return Decoded(tuple(stages), features)


def initial_points(
    seeds: Float[Array, "S 3"], partial: Float[Array, "N 3"], num_points: int
) -> Float[Array, "num_points 3"]:
    """Farthest points of the seeds and the partial, in farthest-point order."""
    together = jnp.concatenate([seeds, partial])
    return together[farthest_order(together, num_points)]


def _order(xyz: Array) -> Array:
    """Farthest-point order as far as a coarser resolution looks at it."""
    return over_batch(lambda cloud: farthest_order(cloud, cloud.shape[0] // 2))(xyz)


def _cloud(xyz: Array, features: Array) -> Cloud:
    return Cloud(xyz, features, _order(xyz))


def _pyramids(
    xyz: Array,
    order: Array,
    support: Cloud,
    rates: tuple[int, ...],
    num_neighbors: tuple[int, ...],
) -> tuple[Pyramid, Pyramid]:
    def build(xyz: Array, order: Array, other: Array, other_order: Array):
        rows = resolution_rows(order, xyz.shape[0], rates)
        other_rows = resolution_rows(other_order, other.shape[0], rates)
        inter = build_pyramid(xyz, other, rows, other_rows, num_neighbors)
        intra = build_pyramid(xyz, xyz, rows, rows, num_neighbors, same=True)
        return inter, intra

    clouds = jax.lax.stop_gradient((xyz, support.xyz))
    return over_batch(build)(clouds[0], order, clouds[1], support.order)
