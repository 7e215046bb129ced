"""SeedFormer: patch seeds, and up-sampling layers that look their features up.

Zhou et al., SeedFormer: Patch Seeds based Point Cloud Completion with Upsample
Transformer, ECCV 2022, section 3.
"""

import dataclasses
import math
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn
from prism_jax.models.attention import attend, hidden_and_values, interpolate
from prism_jax.models.encoder import SetAbstraction
from prism_jax.models.layers import (
    MLP,
    Dense,
    ResidualMLP,
    SplitPoints,
    highest,
    over_batch,
    repeat_in_place,
    take,
)
from prism_jax.models.pyramid import sampled_rows


@dataclasses.dataclass(frozen=True)
class PatchConfig:
    """Sizes of a network that grows points from seeds. The defaults are SeedFormer's
    for PCN.

    Attributes:
      num_points: points of the partial cloud.
      patch_points: points left by the two set abstractions.
      patch_features: hidden and output widths of the two set abstractions.
      global_features: hidden and output widths of the global feature.
      patch_neighbors: neighbours in set abstractions.
      num_neighbors: neighbours in transformers.
      features: width of per-point features in the decoder.
      attention_features: width inside an attention.
      attention_ratio: expansion of its hidden layer.
      num_initial: points sampled from seeds and partial, from which refinement starts.
      up_factors: children per point of each up-sampling layer.
      use_norm: BatchNorm in the attentions.
      offset_init: standard deviation of the kernels that make coordinate offsets.
    """

    num_points: int = 2048
    patch_points: tuple[int, int] = (512, 128)
    patch_features: tuple[tuple[int, int], tuple[int, int]] = ((64, 128), (128, 256))
    global_features: tuple[int, int] = (512, 512)
    patch_neighbors: int = 16
    num_neighbors: int = 20
    features: int = 128
    attention_features: int = 64
    attention_ratio: int = 4
    num_initial: int = 512
    up_factors: tuple[int, ...] = (1, 4, 8)
    use_norm: bool = True
    offset_init: float = 0.01

    @property
    def num_outputs(self) -> int:
        """Points of the last stage."""
        return self.num_initial * math.prod(self.up_factors)


@dataclasses.dataclass(frozen=True)
class SeedFormerConfig(PatchConfig):
    """Sizes. The defaults are the published network for PCN.

    Attributes:
      seed_times: seeds per patch point.
      seeds_from_patches: seeds are offsets from their patch points, and not absolute
        coordinates as published; a short training gets further so.
    """

    seed_times: int = 2
    seeds_from_patches: bool = False


SEEDFORMER_SMALL = SeedFormerConfig(
    num_points=512,
    patch_points=(256, 64),
    patch_features=((32, 64), (64, 128)),
    global_features=(256, 256),
    patch_neighbors=8,
    num_neighbors=8,
    features=64,
    attention_features=32,
    attention_ratio=2,
    seeds_from_patches=True,
    num_initial=256,
    up_factors=(1, 8),
    use_norm=False,
)
"""512 points in, 128 / 256 / 2,048 out: the sizes of the backbone's preset `small`.
634,089 parameters."""


class Patches(NamedTuple):
    """What the encoder makes of a partial cloud."""

    xyz: Float[Array, "... M 3"]
    features: Float[Array, "... M C"]
    neighbors: Int[Array, "... M k"]
    global_feature: Float[Array, "... G"]


class SeedFormer(nn.Module):
    """Completes a partial cloud: seeds, then a stage for each up-sampling layer.

    The stages are 256 / 512 / 2,048 / 16,384 points by default, in the units and the
    frame of the partial, which should about fill ``[-1, 1]^3``: the network sees
    absolute coordinates. Differentiable in the parameters and the partial; samples and
    neighbours carry no gradient. The order of the partial's points does not matter but
    for the first, where sampling starts. Coordinates must be finite; an empty cloud
    raises ValueError. Without BatchNorm, `train` changes nothing.

    The default has 3,308,620 parameters. The authors' code has 3,311,820, of which
    3,200 belong to BatchNorm layers that it never applies; sizes, and weights by
    inverse squared distance, are as there. Deviations: the initialisers are this
    package's, and offsets start near zero (`offset_init`); the loss is not part of the
    network, so that the paper's partial matching term is left to the caller. With
    `seeds_from_patches`, seeds are not absolute.
    """

    config: SeedFormerConfig = SeedFormerConfig()

    @nn.compact
    def __call__(
        self, partial: Float[Array, "*batch N 3"], train: bool = False
    ) -> tuple[Float[Array, "*batch _ 3"], ...]:
        if partial.shape[-2] == 0:
            raise ValueError("an empty cloud cannot be completed")
        config = self.config
        patches = Encoder(config, name="encoder")(partial, train)
        seeds = SeedGenerator(config, name="seed_generator")(patches, train)
        joined = jnp.concatenate([seeds[0], partial], axis=-2)
        xyz = take(joined, sampled_rows(joined, config.num_initial))
        stages, features = [seeds[0]], None
        for i, times in enumerate(config.up_factors):
            layer = UpsamplingLayer(config, times, name=f"layer_{i}")
            xyz, features = layer(xyz, features, *seeds, train)
            stages.append(xyz)
        return tuple(stages)


class Encoder(nn.Module):
    """Two set abstractions, each with a point transformer, then the global feature."""

    config: PatchConfig

    @nn.compact
    def __call__(
        self, partial: Float[Array, "... N 3"], train: bool = False
    ) -> Patches:
        config = self.config
        # A shorter farthest-point sample is the prefix of a longer one.
        sampled = take(partial, sampled_rows(partial, config.patch_points[0]))
        xyz = features = partial
        neighbors = jnp.zeros((), int)
        levels = zip(config.patch_points, config.patch_features, strict=True)
        for i, (num_points, widths) in enumerate(levels):
            centers = sampled[..., :num_points, :]
            near = _nearest(centers, xyz, config.patch_neighbors)
            abstract = SetAbstraction(widths, name=f"abstraction_{i}")
            features = abstract(centers, xyz, features, near)
            neighbors = _nearest(centers, centers, config.num_neighbors)
            transformer = PointTransformer(config, name=f"transformer_{i}")
            features = transformer(centers, features, neighbors, train)
            xyz = centers
        pointwise = MLP(config.global_features, name="global")(xyz, features)
        return Patches(xyz, features, neighbors, highest(pointwise))


class SeedGenerator(nn.Module):
    """Patch seeds: points of the complete cloud, each with a feature."""

    config: SeedFormerConfig

    @nn.compact
    def __call__(
        self, patches: Patches, train: bool = False
    ) -> tuple[Float[Array, "... S 3"], Float[Array, "... S C"]]:
        config = self.config
        width = config.features
        upsample = UpsampleTransformer(config, config.seed_times, name="upsample")
        features = patches.features
        x = upsample(patches.xyz, features, features, patches.neighbors, None, train)
        context = patches.global_feature[..., None, :]
        x = ResidualMLP(width, width, name="mlp_1")(x, context)
        x = ResidualMLP(width // 2, width, name="mlp_2")(x)
        x = ResidualMLP(width, width, name="mlp_3")(x, context)
        seeds = MLP((width // 2, 3), name="coordinates")(x)
        if config.seeds_from_patches:
            seeds = seeds + repeat_in_place(patches.xyz, config.seed_times)
        return seeds, x


class UpsamplingLayer(nn.Module):
    """Children of every point, at offsets of at most 1 an axis, and their features.

    ``features`` are those that the last layer gave its children; the first layer has
    none. Each point looks its seed feature up from its three nearest seeds, weighted by
    inverse squared distance.
    """

    config: SeedFormerConfig
    times: int

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        features: Float[Array, "... N C"] | None,
        seeds: Float[Array, "... S 3"],
        seed_features: Float[Array, "... S C"],
        train: bool = False,
    ) -> tuple[Float[Array, "... M 3"], Float[Array, "... M C"]]:
        width = self.config.features
        nearest_seeds = _nearest(xyz, seeds, 3)
        looked_up = interpolate(xyz, seeds, seed_features, nearest_seeds)
        x = MLP((width // 2, width), name="point_0")(xyz)
        of_all = highest(x)[..., None, :]
        x = MLP((2 * width, width), name="point_1")(x, of_all, looked_up)

        neighbors = _nearest(xyz, xyz, self.config.num_neighbors)
        for name, times in (("transformer", 1), ("upsample", self.times)):
            parents = x
            upsample = UpsampleTransformer(self.config, times, name=name)
            key = x if features is None else features
            x = upsample(xyz, x, key, neighbors, looked_up, train)
        parents = repeat_in_place(parents, self.times)
        x = ResidualMLP(width, width, name="child")(x, parents)
        init = nn.initializers.normal(self.config.offset_init)
        offsets = MLP((width // 2, 3), final_init=init, name="offset")(nn.relu(x))
        return repeat_in_place(xyz, self.times) + jnp.tanh(offsets), x


class PointTransformer(nn.Module):
    """Vector attention over neighbours in a narrower width (Zhao et al., Point
    Transformer, ICCV 2021)."""

    config: PatchConfig

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        features: Float[Array, "... N C"],
        neighbors: Int[Array, "... N k"],
        train: bool = False,
    ) -> Float[Array, "... N C"]:
        config = self.config
        width = config.attention_features
        x = Dense(width, name="start")(features)
        query, key, value = (Dense(width, name=n)(x) for n in ("query", "key", "value"))
        hidden, values = hidden_and_values(
            (xyz, query), (xyz, key, value), neighbors, config, train
        )
        logits = Dense(width, name="attention_1")(hidden)
        attended = attend(logits, values)
        return Dense(features.shape[-1], name="end")(attended) + features


class UpsampleTransformer(nn.Module):
    """Vector attention with its own weights for each of a point's ``times`` children.

    Differences of seed features stand beside those of positions, in the weights and in
    the values. Where there are no seeds yet, in their generator, the weights have no
    softmax.
    """

    config: SeedFormerConfig
    times: int

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        query_features: Float[Array, "... N C"],
        key_features: Float[Array, "... N C"],
        neighbors: Int[Array, "... N k"],
        seed_features: Float[Array, "... N S"] | None,
        train: bool = False,
    ) -> Float[Array, "... M D"]:
        config = self.config
        inputs, width = query_features.shape[-1], config.attention_features
        joined = ResidualMLP(inputs, inputs, name="join")(key_features, query_features)
        query = Dense(width, name="query")(query_features)
        key = Dense(width, name="key")(key_features)
        value = Dense(width, name="value")(joined)
        seed = None
        if seed_features is not None:
            # The difference s_i - s_j, as one term of the point i and one of j.
            seed = Dense(width, name="seed")(seed_features)
            query, key, value = query + seed, key + seed, value - seed
        hidden, values = hidden_and_values(
            (xyz, query), (xyz, key, value), neighbors, config, train
        )
        logits = SplitPoints(width, self.times, name="attention_1")(hidden)
        logits = logits.reshape(*hidden.shape[:-1], self.times, width)
        # (..., N, times, k, C): all children of a point share its values.
        logits, values = jnp.swapaxes(logits, -3, -2), values[..., None, :, :]
        if seed is None:
            attended = (logits * values).sum(-2)
        else:
            # Weights that sum to one leave the point's own term as it is.
            attended = attend(logits, values) + seed[..., None, :]
        attended = attended.reshape(*xyz.shape[:-2], -1, width)
        if inputs != config.features:
            joined = Dense(config.features, name="residual")(joined)
        end = Dense(config.features, name="end")(attended)
        return end + repeat_in_place(joined, self.times)


def _nearest(query: Array, support: Array, k: int) -> Array:
    return over_batch(lambda q, s: knn(q, s, k))(query, support)
