"""FSC: two branches that read every point, one feature of both that is revised, and a
grid folded around coarse points that know of their neighbourhood.

Wu et al., FSC: Few-point Shape Completion, CVPR 2024, section 4. Sizes are those of the
authors' release (https://github.com/xianzuwu/FSC).
"""

import dataclasses
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from experiments.baselines.pcn import folding_grid
from prism_jax.geometry.neighbors import knn
from prism_jax.models.layers import (
    Affine,
    Dense,
    SplitPoints,
    batch_norm,
    highest,
    joined_dense,
    over_batch,
    repeat_in_place,
    take,
)

LEAK = 0.2
"""Slope of most activations below zero."""


@dataclasses.dataclass(frozen=True)
class FSCConfig:
    """Sizes of FSC. The defaults are the published network.

    Attributes:
      num_points: points of the partial cloud that it is trained with; it takes any.
      local_features: widths of the layers over single points, of both branches; the
        last is the width of their first global feature.
      global_features: widths of the layers over points that know of that feature; the
        last is the width of the second.
      coarse_features: hidden widths of the MLP that makes the coarse points.
      num_coarse: coarse points.
      near_features: widths of the layers over a coarse point's neighbours.
      num_neighbors, radius: how many of these there are, and how far off at most, in
        the units of the cloud.
      fold_features: hidden widths of the MLP that folds the grid.
      grid_size: points along a side of the grid.
      grid_extent: half of the grid's side, in the units of the cloud.
      use_norm: BatchNorm behind every layer but those of the coarse MLP and the last.
    """

    num_points: int = 2048
    local_features: tuple[int, int, int] = (64, 128, 256)
    global_features: tuple[int, int, int] = (512, 1024, 1024)
    coarse_features: tuple[int, ...] = (2048, 1024, 2048)
    num_coarse: int = 1024
    near_features: tuple[int, ...] = (64, 128, 256)
    num_neighbors: int = 32
    radius: float = 0.2
    fold_features: tuple[int, ...] = (512, 512)
    grid_size: int = 4
    grid_extent: float = 0.05
    use_norm: bool = True

    @property
    def num_outputs(self) -> int:
        """Points of the dense stage."""
        return self.num_coarse * self.grid_size**2


FSC_SMALL = FSCConfig(
    num_points=512,
    local_features=(32, 64, 64),
    global_features=(128, 256, 256),
    coarse_features=(384, 256, 384),
    num_coarse=128,
    near_features=(16, 32, 64),
    num_neighbors=8,
    radius=0.5,
    fold_features=(128, 128),
    use_norm=False,
)
"""512 points in, 128 and 2,048 out: widths of a quarter or a half, and a radius that
holds as many of an eighth of the coarse points. 1,488,307 parameters."""


class FSC(nn.Module):
    """The coarse and the dense points of a partial cloud in the unit workspace.

    The result does not depend on the order of the partial's points. The children of a
    coarse point follow each other in the dense stage. Differentiable in the parameters
    and the partial; which coarse points are neighbours has no gradient. An empty cloud
    raises ValueError; NaN coordinates give NaN. Without BatchNorm, `train` changes
    nothing.

    Deviations: neighbours are the nearest within the radius, where the release takes
    the first in the order of the cloud; children read the neighbourhood of the point
    that they are of, where the release deals these out in another order than the
    points; the decoder of 512 points that the release makes beside the dense one has
    the same inputs and no reader, and is left out; kernels start from LeCun's normal
    distribution. The release sums the Chamfer distances of its stages, as Eq. 10 does.
    """

    config: FSCConfig = FSCConfig()

    @nn.compact
    def __call__(
        self, partial: Float[Array, "*batch N 3"], train: bool = False
    ) -> tuple[Float[Array, "*batch C 3"], Float[Array, "*batch M 3"]]:
        if partial.shape[-2] == 0:
            raise ValueError("an empty cloud cannot be completed")
        config = self.config
        found = [
            ExtensiveBranch(config, name="extensive")(partial, train),
            SaliencyBranch(config, name="saliency")(partial, train),
        ]
        joined = jnp.concatenate(found, axis=-1)
        width = (joined.shape[-1],)
        revised = Layers(width, config.use_norm, 0.0, name="revision")
        feature = revised(joined, train=train)

        hidden = Layers(config.coarse_features, False, name="coarse")(feature)
        coarse = Dense(3 * config.num_coarse, name="coarse_end")(hidden)
        coarse = coarse.reshape(*partial.shape[:-2], config.num_coarse, 3)

        near = Neighbourhood(config, name="near")(coarse, train)
        grid = folding_grid(config.grid_size, config.grid_extent)
        grid = jnp.tile(grid, (config.num_coarse, 1))
        fold = Layers(config.fold_features, config.use_norm, name="fold")
        offsets = Dense(3, name="fold_end")(fold(grid, near, feature, train=train))
        return coarse, repeat_in_place(coarse, config.grid_size**2) + offsets


class Layers(nn.Module):
    """Dense layers with BatchNorm, if it is used, and an activation behind each.

    Several inputs are joined as in `prism_jax.models.layers.joined_dense`.
    """

    features: Sequence[int]
    use_norm: bool
    leak: float = LEAK

    @nn.compact
    def __call__(
        self, *parts: Float[Array, "... _ _"], train: bool = False
    ) -> Float[Array, "... N D"]:
        for i, width in enumerate(self.features):
            layer = Affine(width, name=f"dense_{i}")(parts)
            x = joined_dense(parts, *layer)
            if self.use_norm:
                x = batch_norm(train, name=f"norm_{i}")(x)
            parts = (nn.leaky_relu(x, self.leak),)
        return parts[0]


class ExtensiveBranch(nn.Module):
    """PCN's encoder, with both of its maxima in what it returns."""

    config: FSCConfig

    @nn.compact
    def __call__(
        self, partial: Float[Array, "*batch N 3"], train: bool
    ) -> Float[Array, "*batch 1 F"]:
        config = self.config
        local = Layers(config.local_features, config.use_norm, name="local")
        points = local(partial, train=train)
        low = highest(points)[..., None, :]
        whole = Layers(config.global_features, config.use_norm, name="global")
        points = whole(points, low, train=train)
        return jnp.concatenate([low, highest(points)[..., None, :]], axis=-1)


class SaliencyBranch(nn.Module):
    """The same with attention of all points to all between the layers."""

    config: FSCConfig

    @nn.compact
    def __call__(
        self, partial: Float[Array, "*batch N 3"], train: bool
    ) -> Float[Array, "*batch 1 F"]:
        config = self.config
        first, second, last = config.local_features
        wide, *rest = config.global_features

        def layers(*features: int, name: str) -> Layers:
            return Layers(features, config.use_norm, name=name)

        def attention(name: str) -> OffsetAttention:
            return OffsetAttention(config.use_norm, name=name)

        x = layers(first, name="layer_0")(partial, train=train)
        x = attention("attention_0")(x, train)
        x = layers(first, second, name="layer_1")(x, train=train)
        one = attention("attention_1")(x, train)
        two = attention("attention_2")(one, train)
        x = layers(last, name="layer_2")(one, two, train=train)
        low = highest(x)[..., None, :]
        x = layers(wide, name="layer_3")(x, low, train=train)
        one = attention("attention_3")(x, train)
        two = attention("attention_4")(one, train)
        x = layers(*rest, name="layer_4")(one, two, train=train)
        return jnp.concatenate([low, highest(x)[..., None, :]], axis=-1)


class OffsetAttention(nn.Module):
    """What a point has beyond what all attend to in it (PCT, Guo et al., 2021, section
    3.3): queries and keys are the same, and weights are normalised twice."""

    use_norm: bool

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch N C"], train: bool
    ) -> Float[Array, "*batch N C"]:
        width = x.shape[-1]
        keys = SplitPoints(width // 4, 1, use_bias=False, name="query_key")(x)
        energy = keys @ jnp.swapaxes(keys, -1, -2)
        weights = jax.nn.softmax(energy, axis=-1)
        weights = weights / (1e-9 + weights.sum(axis=-2, keepdims=True))
        values = Dense(width, name="value")(x)
        attended = jnp.swapaxes(weights, -1, -2) @ values
        layer = Layers((width,), self.use_norm, 0.0, name="offset")
        return x + layer(x - attended, train=train)


class Neighbourhood(nn.Module):
    """A feature of each coarse point's neighbours (PointNet++)."""

    config: FSCConfig

    @nn.compact
    def __call__(
        self, coarse: Float[Array, "*batch C 3"], train: bool
    ) -> Float[Array, "*batch C D"]:
        config = self.config
        count = min(config.num_neighbors, coarse.shape[-2])
        fixed = jax.lax.stop_gradient(coarse)
        rows = over_batch(lambda cloud: knn(cloud, cloud, count))(fixed)
        apart = jnp.linalg.norm(take(fixed, rows) - fixed[..., None, :], axis=-1)
        rows = jnp.where(apart <= config.radius, rows, rows[..., :1])
        there = take(coarse, rows)
        grouped = jnp.concatenate([there - coarse[..., None, :], there], axis=-1)
        layers = Layers(config.near_features, config.use_norm, 0.0, name="layers")
        return highest(layers(grouped, train=train))
