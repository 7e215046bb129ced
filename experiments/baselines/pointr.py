"""PoinTr: completion as the translation of one set of point proxies into another.

Yu et al., PoinTr: Diverse Point Cloud Completion with Geometry-Aware Transformers,
ICCV 2021, section 3. Sizes that the paper leaves open are those of the authors' release
for PCN (https://github.com/yuxumin/PoinTr, cfgs/PCN_models/PoinTr.yaml).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.models.layers import (
    MLP,
    Affine,
    Dense,
    batch_norm,
    bias_init,
    highest,
    joined_dense,
    kernel_init,
    matmul,
    over_batch,
    take,
)


@dataclasses.dataclass(frozen=True)
class PoinTrConfig:
    """Sizes of PoinTr. The defaults are the published network for PCN.

    Attributes:
      num_points: points of the partial cloud.
      num_centers: points left by the feature extractor's two samplings; the last of
        them become point proxies.
      center_features: width of the extractor's input layer, then of its four edge
        convolutions.
      center_neighbors: neighbours in the edge convolutions.
      norm_groups: groups of the edge convolutions' GroupNorm.
      features: width of the proxies.
      num_heads: heads of an attention.
      depth: transformer blocks of the encoder and of the decoder.
      geometric_depth: how many of each, from the first on, are geometry-aware.
      block_neighbors: neighbours in their branch.
      mlp_ratio: expansion of a block's hidden layer.
      position_features: hidden width of the position embedding.
      global_features: width of the two global features and of the query generator.
      num_queries: centres that points are rebuilt around, at most ``num_centers[0]``.
      use_norm: BatchNorm and GroupNorm; LayerNorm is always there.
      fold_side: points along a side of the grid that is folded around each centre.
      fold_features: hidden widths of the two foldings.
    """

    num_points: int = 2048
    num_centers: tuple[int, int] = (512, 128)
    center_features: tuple[int, int, int, int, int] = (8, 32, 64, 64, 128)
    center_neighbors: int = 16
    norm_groups: int = 4
    features: int = 384
    num_heads: int = 6
    depth: tuple[int, int] = (6, 8)
    geometric_depth: int = 1
    block_neighbors: int = 8
    mlp_ratio: int = 2
    position_features: int = 128
    global_features: int = 1024
    num_queries: int = 224
    use_norm: bool = True
    fold_side: int = 8
    fold_features: tuple[int, int] = (256, 128)

    def __post_init__(self) -> None:
        if self.num_queries > self.num_centers[0]:
            raise ValueError("PoinTr needs at least as many centers as queries")

    @property
    def stage_sizes(self) -> tuple[int, int]:
        """Points of the coarse and of the dense stage."""
        predicted = self.num_queries * self.fold_side**2
        return 2 * self.num_queries, predicted + self.num_points

    @property
    def num_outputs(self) -> int:
        """Points of the last stage, the partial's own among them."""
        return self.stage_sizes[-1]


POINTR_SMALL = PoinTrConfig(
    num_points=512,
    num_centers=(256, 64),
    center_features=(8, 16, 32, 32, 64),
    center_neighbors=8,
    features=80,
    num_heads=5,
    depth=(3, 4),
    position_features=64,
    global_features=224,
    num_queries=96,
    fold_side=4,
    fold_features=(64, 32),
    use_norm=False,
)
"""512 points in, 2,048 out, for training on a CPU."""


class ProxyIndices(NamedTuple):
    """All integers that depend on the partial alone. Farthest points come in order, so
    that the first of them are a coarser sample.

    Attributes:
      rows: the farthest points, ``num_centers[0]`` of them.
      neighbors: each point's neighbours in the partial.
      center_neighbors: each farthest point's among the farthest points.
      proxy_neighbors: each proxy's among the proxies.
    """

    rows: Int[Array, "... n"]
    neighbors: Int[Array, "... N k"]
    center_neighbors: Int[Array, "... n k"]
    proxy_neighbors: Int[Array, "... m j"]


def proxy_indices(partial: Float[Array, "N 3"], config: PoinTrConfig) -> ProxyIndices:
    """Samples and neighbours of one partial cloud."""
    num_centers, num_proxies = config.num_centers
    rows = farthest_point_sample(partial, num_centers)
    centers = partial[rows]
    proxies = centers[:num_proxies]
    return ProxyIndices(
        rows,
        knn(partial, partial, config.center_neighbors),
        knn(centers, centers, config.center_neighbors),
        knn(proxies, proxies, config.block_neighbors),
    )


class NormMLP(nn.Module):
    """Dense layers with BatchNorm and a leaky ReLU between them, none after the last.

    Several inputs are joined as in `joined_dense`.
    """

    features: Sequence[int]
    use_norm: bool
    slope: float = 0.2

    @nn.compact
    def __call__(
        self, *parts: Float[Array, "... _ _"], train: bool = False
    ) -> Float[Array, "... N D"]:
        x = self._dense(0, parts)
        for i in range(1, len(self.features)):
            if self.use_norm:
                x = batch_norm(train, f"norm_{i - 1}")(x)
            x = self._dense(i, (nn.leaky_relu(x, self.slope),))
        return x

    def _dense(self, i: int, parts: Sequence[Array]) -> Array:
        layer = Affine(self.features[i], name=f"dense_{i}")(parts)
        return joined_dense(parts, *layer)


class EdgeConv(nn.Module):
    """The maximum over neighbours of ``LeakyReLU(W [x_j - x_i, x_i])``.

    Of DGCNN (Wang et al., Dynamic Graph CNN for Learning on Point Clouds, 2019), with
    neighbours in space. With ``norm_groups``, GroupNorm over all edges of a cloud
    stands in place of the bias.
    """

    features: int
    norm_groups: int | None = None

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "... M C"],
        support: Float[Array, "... N C"],
        neighbors: Int[Array, "... M k"],
    ) -> Float[Array, "... M D"]:
        shape = (2 * query.shape[-1], self.features)
        offset, own = jnp.split(self.param("kernel", kernel_init, shape), 2)
        # W [x_j - x_i, x_i], before x_j is gathered into k times as many edges.
        center = matmul(query, own - offset)
        edges = take(matmul(support, offset), neighbors)
        if self.norm_groups is None:
            # A LeakyReLU keeps the order: the maximum may come first.
            center = center + self.param("bias", bias_init, (self.features,))
            return nn.leaky_relu(highest(edges) + center, 0.2)
        norm = nn.GroupNorm(
            self.norm_groups,
            epsilon=1e-5,
            reduction_axes=(-3, -2, -1),
            use_fast_variance=False,
            name="norm",
        )
        return highest(nn.leaky_relu(norm(edges + center[..., None, :]), 0.2))


class Attention(nn.Module):
    """Multi-head attention (Vaswani et al., 2017); only its last layer has a bias."""

    num_heads: int

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "... M C"],
        support: Float[Array, "... N C"],
    ) -> Float[Array, "... M C"]:
        q, k, v = (
            self._heads(name, x)
            for name, x in (("query", query), ("key", support), ("value", support))
        )
        logits = jnp.einsum("...mhc,...nhc->...hmn", q, k) / q.shape[-1] ** 0.5
        attended = jnp.einsum("...hmn,...nhc->...mhc", jax.nn.softmax(logits), v)
        return Dense(query.shape[-1], name="end")(attended.reshape(query.shape))

    def _heads(self, name: str, x: Array) -> Array:
        kernel = self.param(name, kernel_init, (x.shape[-1], x.shape[-1]))
        return matmul(x, kernel).reshape(*x.shape[:-1], self.num_heads, -1)


class GeometryAwareAttention(nn.Module):
    """Attention, and where neighbours are given an edge convolution over them beside
    it; a linear layer joins the two. The paper's geometry-aware block."""

    num_heads: int

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "... M C"],
        support: Float[Array, "... N C"],
        neighbors: Int[Array, "... M k"] | None,
    ) -> Float[Array, "... M C"]:
        attention = Attention(self.num_heads, name="attention")
        attended = attention(query, support)
        if neighbors is None:
            return attended
        width = query.shape[-1]
        local = EdgeConv(width, name="geometry")(query, support, neighbors)
        return MLP((width,), name="merge")(attended, local)


class Block(nn.Module):
    """A transformer block, normalised before each part: attention among the tokens,
    to the encoder's where these are given, and an MLP."""

    num_heads: int
    mlp_ratio: int

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "... M C"],
        neighbors: Int[Array, "... M k"] | None,
        encoded: Float[Array, "... N C"] | None = None,
        encoded_neighbors: Int[Array, "... M k"] | None = None,
    ) -> Float[Array, "... M C"]:
        y = _layer_norm("norm_self")(x)
        attention = GeometryAwareAttention(self.num_heads, name="self_attention")
        x = x + attention(y, y, neighbors)
        if encoded is not None:
            y, support = _layer_norm("norm_query")(x), _layer_norm("norm_key")(encoded)
            attention = GeometryAwareAttention(self.num_heads, name="cross_attention")
            x = x + attention(y, support, encoded_neighbors)
        y = Dense(self.mlp_ratio * x.shape[-1], name="mlp_0")(
            _layer_norm("norm_mlp")(x)
        )
        return x + Dense(x.shape[-1], name="mlp_1")(nn.gelu(y, approximate=False))


def _layer_norm(name: str) -> nn.LayerNorm:
    return nn.LayerNorm(epsilon=1e-5, name=name)


class ProxyExtractor(nn.Module):
    """A feature for each proxy's neighbourhood: four edge convolutions over fewer and
    fewer points."""

    config: PoinTrConfig

    @nn.compact
    def __call__(
        self, partial: Float[Array, "... N 3"], indices: ProxyIndices
    ) -> Float[Array, "... m C"]:
        first, *widths = self.config.center_features
        groups = self.config.norm_groups if self.config.use_norm else None
        conv_0, conv_1, conv_2, conv_3 = (
            EdgeConv(width, groups, name=f"conv_{i}") for i, width in enumerate(widths)
        )
        num_proxies = self.config.num_centers[1]
        x = Dense(first, name="input")(partial)
        x = conv_0(x, x, indices.neighbors)
        around = take(indices.neighbors, indices.rows)
        x = conv_1(take(x, indices.rows), x, around)
        x = conv_2(x, x, indices.center_neighbors)
        around = indices.center_neighbors[..., :num_proxies, :]
        return conv_3(x[..., :num_proxies, :], x, around)


# To be called inside a compact module, to which the submodules made here belong.


def encode(
    config: PoinTrConfig,
    partial: Float[Array, "... N 3"],
    proxies: Float[Array, "... m 3"],
    indices: ProxyIndices,
    train: bool,
) -> Float[Array, "... m C"]:
    """The encoder's tokens, one a proxy."""
    width = config.features
    x = ProxyExtractor(config, name="extractor")(partial, indices)
    x = _mlp(config, "input", (width, width))(x, train=train)
    embedding = _mlp(config, "position", (config.position_features, width))
    position = embedding(proxies, train=train)
    for i in range(config.depth[0]):
        near = indices.proxy_neighbors if i < config.geometric_depth else None
        x = _block(config, f"encoder_{i}")(x + position, near)
    return x


def decode(
    config: PoinTrConfig,
    queries: Float[Array, "... M C"],
    encoded: Float[Array, "... m C"],
    neighbors: tuple[Int[Array, "... M k"], Int[Array, "... M k"]],
) -> Float[Array, "... M C"]:
    """The decoder's tokens, one a query, whose neighbours are among the queries and
    among the encoder's tokens."""
    x = queries
    for i in range(config.depth[1]):
        own, across = neighbors if i < config.geometric_depth else (None, None)
        x = _block(config, f"decoder_{i}")(x, own, encoded, across)
    return x


def global_feature(
    config: PoinTrConfig, name: str, x: Float[Array, "... m C"], train: bool
) -> Float[Array, "... 1 G"]:
    """The maximum over the tokens, with an axis of one token."""
    width = config.global_features
    mlp = _mlp(config, f"global_{name}", (width, width))
    return highest(mlp(x, train=train))[..., None, :]


def _mlp(config: PoinTrConfig, name: str, features: tuple[int, ...]) -> NormMLP:
    return NormMLP(features, config.use_norm, name=name)


def _block(config: PoinTrConfig, name: str) -> Block:
    return Block(config.num_heads, config.mlp_ratio, name=name)


class PoinTr(nn.Module):
    """PoinTr: ``(coarse, dense)`` from a partial cloud of ``config.num_points`` points.

    The partial is turned into proxies, one for the neighbourhood of each of a few
    farthest points; an encoder relates them; centres are predicted from a global
    feature, one query each; a decoder turns the queries into proxies of the whole
    shape; a FoldingNet rebuilds points around every centre. As in the authors' release
    for PCN, 224 x 64 points are rebuilt and the 2,048 of the partial are appended
    unchanged, which makes 16,384; and as many farthest points of the partial as there
    are centres are appended to the centres.

    Coordinates are in the workspace's frame, [-1, 1]. Both stages are differentiable in
    the parameters and the partial, piecewise: samples and neighbours have no gradient.
    The order of the points does not matter beyond which of them comes first, where
    farthest-point sampling starts, and the order in which the partial is appended.
    Another number of points raises `ValueError`; NaN coordinates give NaN.

    The default has 31,276,806 parameters. The authors' release declares 42,498,054, of
    which 11,221,248 are neighbour branches of the later 12 blocks that never run and
    are not made here; the rest is the same, array by array.

    Deviations from the paper and the release: ``train=True`` moves the running
    statistics of BatchNorm by a constant 0.1, where the release begins at 0.9 and
    lowers it, and takes the batch's own variance, where PyTorch takes the unbiased one;
    kernels start from LeCun's normal distribution, there from a truncated normal of
    0.02 and from Xavier's; sampling does not leave out points near the origin, as the
    CUDA kernel used there does. `POINTR_SMALL` has half the blocks, narrower, and
    neither BatchNorm nor GroupNorm. The release trains on CD-L1 of both stages against
    the whole complete cloud.
    """

    config: PoinTrConfig = PoinTrConfig()

    @nn.compact
    def __call__(
        self, partial: Float[Array, "... N 3"], train: bool = False
    ) -> tuple[Float[Array, "... _ 3"], Float[Array, "... _ 3"]]:
        config = self.config
        if partial.shape[-2] != config.num_points:
            raise ValueError(f"PoinTr was made for {config.num_points} points")
        indices = over_batch(lambda cloud: proxy_indices(cloud, config))(partial)
        sampled = take(partial, indices.rows)
        proxies = sampled[..., : config.num_centers[1], :]
        encoded = encode(config, partial, proxies, indices, train)
        centers, queries = self._queries(encoded, train)
        k = config.block_neighbors
        near = over_batch(lambda c, p: (knn(c, c, k), knn(c, p, k)))(centers, proxies)
        decoded = decode(config, queries, encoded, near)
        rebuilt = self._rebuild(centers, decoded, train)
        seen = sampled[..., : config.num_queries, :]
        coarse = jnp.concatenate([centers, seen], axis=-2)
        return coarse, jnp.concatenate([rebuilt, partial], axis=-2)

    def _queries(self, encoded: Array, train: bool) -> tuple[Array, Array]:
        """Centres from the encoder's global feature, and a query for each."""
        width, count = self.config.global_features, self.config.num_queries
        context = global_feature(self.config, "encoded", encoded, train)
        centers = MLP((width, 3 * count), name="centers")(context)
        centers = centers.reshape(*encoded.shape[:-2], count, 3)
        mlp = NormMLP((width, width, self.config.features), False, name="queries")
        return centers, mlp(centers, context)

    def _rebuild(self, centers: Array, decoded: Array, train: bool) -> Array:
        """Each centre with a grid folded twice around it."""
        config = self.config
        context = global_feature(config, "decoded", decoded, train)
        x = MLP((config.features,), name="reduce")(decoded, centers, context)
        sides = np.linspace(-1, 1, config.fold_side, dtype=np.float32)
        grid = np.stack(np.meshgrid(sides, sides), axis=-1).reshape(-1, 2)
        folded = jnp.tile(jnp.asarray(grid, x.dtype), (config.num_queries, 1))
        for i in range(2):
            widths = (*config.fold_features, 3)
            fold = NormMLP(widths, config.use_norm, slope=0.0, name=f"fold_{i}")
            folded = fold(folded, x, train=train)
        return folded + jnp.repeat(centers, len(grid), axis=-2)
