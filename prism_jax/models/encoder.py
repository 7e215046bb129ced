"""The point stream's encoder: two set abstractions and two intra-level transformers."""

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn
from prism_jax.models import pyramid
from prism_jax.models.attention import Cloud, CrossResolutionTransformer
from prism_jax.models.config import BackboneConfig
from prism_jax.models.layers import MLP, Dense, highest, over_batch, take


class EncoderIndices(NamedTuple):
    """All integers of the encoder. They depend on the partial alone: compute them once
    per frame, and pass them to every adaptation step."""

    rows: tuple[Int[Array, "... n"], Int[Array, "... m"]]
    neighbors: tuple[Int[Array, "... n k"], Int[Array, "... m k"]]
    pyramids: tuple[pyramid.Pyramid, pyramid.Pyramid]
    patch_neighbors: Int[Array, "... m k"]


class PointFeatures(NamedTuple):
    """What the decoder and the auxiliary branches see of the partial: its patches,
    their neighbours among each other, and all of it at once."""

    patch_xyz: Float[Array, "... M 3"]
    patch_features: Float[Array, "... M C"]
    global_feature: Float[Array, "... G"]
    patch_neighbors: Int[Array, "... M k"]


def encoder_indices(
    partials: Float[Array, "... N 3"], config: BackboneConfig
) -> EncoderIndices:
    """Samples and neighbours of partial clouds. Each is sampled once: coarser
    resolutions are prefixes of its farthest-point order."""
    levels = config.encoder_rates, config.num_neighbors

    def of_cloud(cloud: Array) -> EncoderIndices:
        rows, neighbors, pyramids = [], [], []
        order = pyramid.sampled_rows(cloud, config.patch_points[0])
        for num_points in config.patch_points:
            patches = cloud[order[:num_points]]
            rows.append(order[:num_points])
            neighbors.append(knn(patches, cloud, config.patch_neighbors))
            order = jnp.arange(num_points)
            both = patches, patches, order, order
            pyramids.append(pyramid.build_pyramid(*both, *levels))
            cloud = patches
        around = knn(cloud, cloud, config.patch_neighbors)
        return EncoderIndices(tuple(rows), tuple(neighbors), tuple(pyramids), around)

    return over_batch(of_cloud)(partials)


class SetAbstraction(nn.Module):
    """PointNet++ over given neighbours: relative coordinates and features, a shared
    MLP, the maximum."""

    widths: tuple[int, int]

    @nn.compact
    def __call__(
        self,
        centers: Float[Array, "... M 3"],
        xyz: Float[Array, "... N 3"],
        features: Float[Array, "... N C"],
        neighbors: Int[Array, "... M k"],
    ) -> Float[Array, "... M D"]:
        together = take(jnp.concatenate([xyz, features], -1), neighbors)
        relative = together[..., :3] - centers[..., None, :]
        grouped = jnp.concatenate([relative, together[..., 3:]], -1)
        return highest(MLP(self.widths, name="mlp")(grouped))


class PointEncoder(nn.Module):
    """CRA-PCN's encoder: patch features of the partial, and a global feature. Without
    the partial's indices it computes them."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self,
        partial: Float[Array, "... N 3"],
        indices: EncoderIndices | None = None,
        train: bool = False,
    ) -> PointFeatures:
        config = self.config
        if indices is None:
            indices = encoder_indices(partial, config)
        xyz_1 = take(partial, indices.rows[0])
        abstract = SetAbstraction(config.patch_features[0], name="abstraction_1")
        features_1 = abstract(xyz_1, partial, partial, indices.neighbors[0])
        transformer = CrossResolutionTransformer(config, name="transformer_1")
        cloud = Cloud(xyz_1, features_1)
        features_1 = transformer(cloud, cloud, indices.pyramids[0], train)

        xyz_2 = take(xyz_1, indices.rows[1])
        abstract = SetAbstraction(config.patch_features[1], name="abstraction_2")
        patches = abstract(xyz_2, xyz_1, features_1, indices.neighbors[1])
        reduced = Dense(config.features, name="reduce")(patches)
        transformer = CrossResolutionTransformer(config, name="transformer_2")
        cloud = Cloud(xyz_2, reduced)
        reduced = transformer(cloud, cloud, indices.pyramids[1], train)
        patches = Dense(patches.shape[-1], name="expand")(reduced) + patches

        pointwise = MLP(config.global_features, name="global")(xyz_2, patches)
        global_feature = highest(pointwise)
        return PointFeatures(xyz_2, patches, global_feature, indices.patch_neighbors)
