"""SnowflakeNet: points that split into children, layer after layer.

Xiang et al., SnowflakeNet: Point Cloud Completion by Snowflake Point Deconvolution with
Skip-Transformer, ICCV 2021, section 3. Sizes that the paper leaves open are those of
the authors' release for PCN (https://github.com/AllenXiangX/SnowflakeNet).
"""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from experiments.baselines.seedformer import Encoder, PatchConfig
from prism_jax.geometry.neighbors import knn, nearest
from prism_jax.losses.chamfer import SQUARED_DISTANCE_FLOOR, ChamferNorm
from prism_jax.models.attention import attend, hidden_and_values
from prism_jax.models.decoder import initial_points, initial_rows
from prism_jax.models.layers import (
    MLP,
    Dense,
    ResidualMLP,
    SplitPoints,
    highest,
    over_batch,
    repeat_in_place,
)


@dataclasses.dataclass(frozen=True)
class SnowflakeNetConfig(PatchConfig):
    """Sizes of SnowflakeNet. The defaults are the published network for PCN.

    Attributes:
      num_seeds: points of the first stage.
      seed_features: width of the features that the global one is split into.
    """

    num_neighbors: int = 16
    num_seeds: int = 256
    seed_features: int = 128


SNOWFLAKENET_SMALL = SnowflakeNetConfig(
    num_points=512,
    patch_points=(256, 64),
    patch_features=((32, 64), (64, 128)),
    global_features=(256, 256),
    patch_neighbors=8,
    num_neighbors=8,
    features=64,
    attention_features=32,
    attention_ratio=2,
    num_initial=256,
    up_factors=(1, 2, 4),
    use_norm=False,
    num_seeds=128,
    seed_features=16,
)
"""512 points in, 128 / 256 / 512 / 2,048 out: every width halved, that of the features
that seeds begin with more than that. 1,129,484 parameters."""


class SnowflakeNet(nn.Module):
    """Completes a partial cloud: seeds, then a stage for each point deconvolution.

    The stages are 256 / 512 / 2,048 / 16,384 points by default, in the units and the
    frame of the partial, which should about fill ``[-1, 1]^3``: the network sees
    absolute coordinates. Children follow each other. Differentiable in the parameters
    and the partial; samples and neighbours carry no gradient. The order of the
    partial's points does not matter but for the first, where sampling starts.
    Coordinates must be finite; an empty cloud raises ValueError. Without BatchNorm,
    `train` changes nothing.

    Beside Eq. 10 it is trained on the paper's partial matching loss (`supervised`), as
    in the authors' release with a weight of one.

    Deviations: both transformers attend to the values of the neighbours, as Point
    Transformer does (Zhao et al., ICCV 2021), where the release gives a point its own
    value for all of them; initialisers are this package's, and offsets start near zero
    (`offset_init`). The default has 19,317,612 parameters, as many as the release.
    """

    config: SnowflakeNetConfig = SnowflakeNetConfig()
    own_losses: ClassVar[tuple[str, ...]] = ("partial_matching",)

    @nn.compact
    def __call__(
        self, partial: Float[Array, "*batch N 3"], train: bool = False
    ) -> tuple[Float[Array, "*batch _ 3"], ...]:
        if partial.shape[-2] == 0:
            raise ValueError("an empty cloud cannot be completed")
        config = self.config
        context = Encoder(config, name="encoder")(partial, train).global_feature
        seeds = SeedGenerator(config, name="seed_generator")(context)
        rows = initial_rows(seeds, partial, config.num_initial)
        xyz, displacement = initial_points(seeds, partial, rows), None
        stages = [seeds]
        for i, times in enumerate(config.up_factors):
            layer = PointDeconvolution(config, times, name=f"deconvolution_{i}")
            xyz, displacement = layer(xyz, displacement, context, train)
            stages.append(xyz)
        return tuple(stages)

    def supervised(
        self,
        partial: Float[Array, "*batch N 3"],
        complete: Float[Array, "*batch M 3"],
        norm: ChamferNorm,
        train: bool = True,
    ) -> tuple[tuple[Float[Array, "*batch _ 3"], ...], Float[Array, "*batch 1"]]:
        """The stages, and the distance of the partial from the last of them."""
        stages = self(partial, train)
        matching = over_batch(lambda p, stage: partial_matching(p, stage, norm))
        return stages, matching(partial, stages[-1])[..., None]


def partial_matching(
    partial: Float[Array, "N 3"], prediction: Float[Array, "M 3"], norm: ChamferNorm
) -> Float[Array, ""]:
    """The mean distance of the partial's points to the nearest predicted ones, squared
    with `"l2"`: one direction of the Chamfer distance, not halved.

    What was measured must be there, while nothing is said of what was not. From Wen et
    al., Cycle4Completion, CVPR 2021. Differentiable as `chamfer`.
    """
    squared, _ = nearest(partial, prediction)
    if norm == "l2":
        return squared.mean()
    return jnp.sqrt(jnp.maximum(squared, SQUARED_DISTANCE_FLOOR)).mean()


class SeedGenerator(nn.Module):
    """The first points, of the global feature alone: it is split into a feature for
    each of them."""

    config: SnowflakeNetConfig

    @nn.compact
    def __call__(
        self, global_feature: Float[Array, "... G"]
    ) -> Float[Array, "... S 3"]:
        config, width = self.config, self.config.features
        context = global_feature[..., None, :]
        x = SplitPoints(config.seed_features, config.num_seeds, name="split")(context)
        x = ResidualMLP(width, width, name="mlp_1")(x, context)
        x = ResidualMLP(width // 2, width, name="mlp_2")(x)
        x = ResidualMLP(width, width, name="mlp_3")(x, context)
        return MLP((width // 2, 3), name="coordinates")(x)


class PointDeconvolution(nn.Module):
    """Snowflake point deconvolution: children of every point, at offsets of at most 1
    an axis, and their displacement features.

    ``displacement`` is what the layer before gave the points here, its children; the
    first layer has none.
    """

    config: SnowflakeNetConfig
    times: int

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        displacement: Float[Array, "... N C"] | None,
        global_feature: Float[Array, "... G"],
        train: bool = False,
    ) -> tuple[Float[Array, "... M 3"], Float[Array, "... M C"]]:
        width = self.config.features
        x = MLP((width // 2, width), name="point_0")(xyz)
        of_all = highest(x)[..., None, :]
        x = MLP((2 * width, width), name="point_1")(
            x, of_all, global_feature[..., None, :]
        )
        neighbors = over_batch(lambda c: knn(c, c, self.config.num_neighbors))(xyz)
        transformer = SkipTransformer(self.config, name="transformer")
        key = x if displacement is None else displacement
        x = transformer(xyz, x, key, neighbors, train)

        split = MLP((width // 2, width // 4), name="reduce")(x)
        split = SplitPoints(width, self.times, use_bias=False, name="split")(split)
        x = ResidualMLP(width, width, name="child")(split, x)
        init = nn.initializers.normal(self.config.offset_init)
        offsets = MLP((width // 2, 3), final_init=init, name="offset")(nn.relu(x))
        return repeat_in_place(xyz, self.times) + jnp.tanh(offsets), x


class SkipTransformer(nn.Module):
    """Vector attention of the points' features to how their neighbours were displaced
    the layer before, or to the neighbours' own features."""

    config: SnowflakeNetConfig

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        query_features: Float[Array, "... N C"],
        key_features: Float[Array, "... N C"],
        neighbors: Int[Array, "... N k"],
        train: bool = False,
    ) -> Float[Array, "... N C"]:
        config = self.config
        inputs, width = query_features.shape[-1], config.attention_features
        joined = ResidualMLP(inputs, inputs, name="join")(key_features, query_features)
        query = Dense(width, name="query")(query_features)
        key = Dense(width, name="key")(key_features)
        value = Dense(width, name="value")(joined)
        hidden, values = hidden_and_values(
            (xyz, query),
            (xyz, key, value),
            neighbors,
            config.attention_ratio,
            config.use_norm,
            train,
        )
        logits = Dense(width, name="attention_1")(hidden)
        return Dense(inputs, name="end")(attend(logits, values)) + joined
