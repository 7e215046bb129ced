"""AdaPoinTr: PoinTr with queries chosen for each cloud, and a denoising task beside it.

Yu et al., AdaPoinTr: Diverse Point Cloud Completion with Adaptive Geometry-Aware
Transformers, TPAMI 2023 (arXiv 2301.04545), sections on adaptive query generation and
on the auxiliary denoising task. Sizes that the paper leaves open are those of the
authors' release for PCN (https://github.com/yuxumin/PoinTr,
cfgs/PCN_models/AdaPoinTr.yaml).
"""

import dataclasses
from typing import ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from experiments.baselines.pointr import (
    NormMLP,
    ProxyConfig,
    decode,
    encode,
    global_feature,
    proxy_indices,
)
from prism_jax.geometry.neighbors import knn
from prism_jax.losses.chamfer import ChamferNorm, chamfer
from prism_jax.models.layers import MLP, highest, over_batch, take


@dataclasses.dataclass(frozen=True)
class AdaPoinTrConfig(ProxyConfig):
    """Sizes of AdaPoinTr. The defaults are the published network for PCN.

    Attributes:
      score_features: hidden widths of the scores of candidates.
      rebuilt_points: points rebuilt around each centre.
      rebuild_features: hidden width of the layers that rebuild them.
      offset_init: standard deviation of the kernel that makes their offsets.
      num_noised: noised centres in training, at most ``num_centers[0]``.
      noise: standard deviation of their noise in the units of the cloud; five of these
        bound it.
      denoising_weight: of their loss.
    """

    num_centers: tuple[int, int] = (512, 256)
    num_queries: int = 512
    score_features: tuple[int, int] = (256, 256)
    rebuilt_points: int = 32
    rebuild_features: int = 512
    offset_init: float = 0.01
    num_noised: int = 64
    noise: float = 0.01
    denoising_weight: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_noised > self.num_centers[0]:
            raise ValueError("AdaPoinTr needs at least as many centers as noised ones")

    @property
    def stage_sizes(self) -> tuple[int, int]:
        """Points of the coarse and of the dense stage."""
        return self.num_queries, self.num_queries * self.rebuilt_points

    @property
    def num_outputs(self) -> int:
        """Points of the last stage."""
        return self.stage_sizes[-1]


ADAPOINTR_SMALL = AdaPoinTrConfig(
    num_points=512,
    num_centers=(256, 64),
    center_features=(8, 16, 32, 32, 64),
    center_neighbors=8,
    features=80,
    num_heads=5,
    depth=(3, 4),
    position_features=64,
    global_features=224,
    num_queries=128,
    use_norm=False,
    score_features=(64, 64),
    rebuilt_points=16,
    rebuild_features=128,
    num_noised=16,
)
"""512 points in, 128 / 2,048 out. Sizes that PoinTr has too are those of
`POINTR_SMALL`, but for the number of queries. 1,018,177 parameters."""


class Rebuilt(NamedTuple):
    """The centres and the points rebuilt around them, of the completion and of the
    noised queries; the latter None without such."""

    coarse: Float[Array, "... M 3"]
    dense: Float[Array, "... _ 3"]
    noised: Float[Array, "... D 3"] | None
    denoised: Float[Array, "... _ 3"] | None


class AdaPoinTr(nn.Module):
    """AdaPoinTr: ``(coarse, dense)`` from a cloud of ``config.num_points`` points.

    Extractor, encoder, decoder and the embedding of queries are those of `PoinTr`. New
    are three things:

    - **Queries.** Candidates are centres predicted from the encoder's global feature,
      and half as many farthest points of the partial. Each gets a score between 0 and 1
      from its coordinates; the ``num_queries`` highest become queries and, in the order
      of their scores, the coarse stage.
    - **Denoising**, in training alone (`supervised`): farthest points of the partial
      with some noise are decoded beside the queries. They see these, but the queries do
      not see them, so that the completion is the same with the task and without. What
      is rebuilt around them is compared with what the complete cloud has nearest to
      each.
    - **Rebuilding** by fully connected layers over each token and the maximum of all,
      in the place of a folded grid. All points of the dense stage are predicted; the
      partial is not appended.

    Coordinates are in the workspace's frame, [-1, 1]. Both stages are differentiable in
    the parameters and the partial, piecewise: samples, neighbours and what is chosen
    have no gradient. The order of the points does not matter beyond which of them comes
    first, where farthest-point sampling starts. Another number of points raises
    `ValueError`; NaN coordinates give NaN.

    Deviations from the paper and the release. The scores learn by a straight-through
    gradient: a chosen query is multiplied by its score over itself, which is one, held
    constant below. The authors speak of a Gumbel softmax, and in their release the
    scores get no gradient at all (issue 137 there). The global feature of the
    rebuilding is that of the completion's tokens; there it has the noised ones too, in
    training. The coarse stage is compared with as many points of the complete cloud as
    it has (Eq. 10), there with all of it. The small perceptrons are PoinTr's: BatchNorm
    where ``use_norm``, leaky ReLUs and as wide as the tokens, where the release has
    GELUs, one wider layer before the encoder, and BatchNorm once; as in `PoinTr`, the
    position is added before every block of the encoder, there before the first.
    Initialisers are this package's, and rebuilt points start near their centres. The
    default has 32,405,953 parameters.
    """

    config: AdaPoinTrConfig = AdaPoinTrConfig()
    own_losses: ClassVar[tuple[str, ...]] = ("denoising",)

    def __call__(
        self, partial: Float[Array, "... N 3"], train: bool = False
    ) -> tuple[Float[Array, "... _ 3"], Float[Array, "... _ 3"]]:
        rebuilt = self._rebuilt(partial, None, train)
        return rebuilt.coarse, rebuilt.dense

    def supervised(
        self,
        partial: Float[Array, "*batch N 3"],
        complete: Float[Array, "*batch M 3"],
        norm: ChamferNorm,
        train: bool = True,
    ) -> tuple[
        tuple[Float[Array, "*batch _ 3"], Float[Array, "*batch _ 3"]],
        Float[Array, "*batch 1"],
    ]:
        """Both stages, and the weighted loss of the denoising task, whose noise comes
        from the stream ``noise``."""
        config = self.config
        shape = (*partial.shape[:-2], config.num_noised, 3)
        noise = jax.random.normal(self.make_rng("noise"), shape, partial.dtype)
        rebuilt = self._rebuilt(partial, config.noise * jnp.clip(noise, -5, 5), train)

        def loss(denoised: Array, noised: Array, complete: Array) -> Array:
            around = complete[knn(noised, complete, config.rebuilt_points)]
            return chamfer(denoised, around.reshape(-1, 3), norm)

        losses = over_batch(loss)(rebuilt.denoised, rebuilt.noised, complete)
        stages = (rebuilt.coarse, rebuilt.dense)
        return stages, config.denoising_weight * losses[..., None]

    @nn.compact
    def _rebuilt(self, partial: Array, noise: Array | None, train: bool) -> Rebuilt:
        """What is rebuilt, and with noise what it is to be told from."""
        config, count = self.config, self.config.num_queries
        if partial.shape[-2] != config.num_points:
            raise ValueError(f"AdaPoinTr was made for {config.num_points} points")
        indices = over_batch(lambda cloud: proxy_indices(cloud, config))(partial)
        sampled = take(partial, indices.rows)
        proxies = sampled[..., : config.num_centers[1], :]
        encoded = encode(config, partial, proxies, indices, train)
        context = global_feature(config, "encoded", encoded, train)
        coarse, scores = self._chosen(context, sampled[..., : count // 2, :])

        centers, visible = coarse, None
        if noise is not None:
            noised = sampled[..., : noise.shape[-2], :] + noise
            centers = jnp.concatenate([coarse, noised], axis=-2)
            visible = sight(count, noise.shape[-2])
        width = config.global_features
        mlp = NormMLP((width, width, config.features), False, name="queries")
        queries = mlp(centers, context)
        through = 1 + scores - jax.lax.stop_gradient(scores)
        chosen = queries[..., :count, :] * through[..., None]
        queries = jnp.concatenate([chosen, queries[..., count:, :]], axis=-2)

        k = config.block_neighbors
        near = over_batch(lambda c, p: (seen_neighbors(c, count, k), knn(c, p, k)))
        decoded = decode(config, queries, encoded, near(centers, proxies), visible)
        rebuilt = self._points(centers, decoded, train)
        if noise is None:
            return Rebuilt(coarse, rebuilt, None, None)
        dense, denoised = jnp.split(rebuilt, [config.num_outputs], axis=-2)
        return Rebuilt(coarse, dense, noised, denoised)

    def _chosen(self, context: Array, seen: Array) -> tuple[Array, Array]:
        """The candidates of the highest scores, and these."""
        config = self.config
        widths = (config.global_features, 3 * config.num_queries)
        centers = MLP(widths, name="centers")(context)
        centers = centers.reshape(*seen.shape[:-2], config.num_queries, 3)
        candidates = jnp.concatenate([centers, seen], axis=-2)
        scores = MLP((*config.score_features, 1), name="scores")(candidates)
        scores = nn.sigmoid(scores)[..., 0]
        return highest_scored(candidates, scores, config.num_queries)

    def _points(self, centers: Array, decoded: Array, train: bool) -> Array:
        """Points around each centre. The noised ones, at the end, change no others."""
        config, count = self.config, self.config.num_queries
        tokens = decoded[..., :count, :]
        context = global_feature(config, "decoded", tokens, train)
        x = MLP((config.features,), name="reduce")(decoded, centers, context)
        of_all = highest(x[..., :count, :])[..., None, :]
        widths = (config.rebuild_features, 3 * config.rebuilt_points)
        init = nn.initializers.normal(config.offset_init)
        offsets = MLP(widths, final_init=init, name="rebuild")(x, of_all)
        offsets = offsets.reshape(*centers.shape[:-1], config.rebuilt_points, 3)
        points = centers[..., None, :] + offsets
        return points.reshape(*centers.shape[:-2], -1, 3)


def highest_scored(
    candidates: Float[Array, "... n D"], scores: Float[Array, "... n"], count: int
) -> tuple[Float[Array, "... m D"], Float[Array, "... m"]]:
    """The ``count`` candidates of the highest scores, highest first, and their scores.

    Of equal scores the first comes first. Differentiable in both, but for what is
    chosen.
    """
    _, rows = jax.lax.top_k(jax.lax.stop_gradient(scores), count)
    return take(candidates, rows), jnp.take_along_axis(scores, rows, axis=-1)


def sight(num_queries: int, num_noised: int) -> Bool[Array, "n n"]:
    """Who sees whom: the queries see each other, the noised ones after them all."""
    noised = jnp.arange(num_queries + num_noised) >= num_queries
    return noised[:, None] | ~noised[None]


def seen_neighbors(
    centers: Float[Array, "n 3"], num_queries: int, k: int
) -> Int[Array, "n k"]:
    """Each centre's nearest among those that it sees (`sight`)."""
    queries = centers[:num_queries]
    own = knn(queries, queries, k)
    if centers.shape[0] == num_queries:
        return own
    return jnp.concatenate([own, knn(centers[num_queries:], centers, k)])
