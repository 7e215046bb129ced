"""Vector attention and the cross-resolution transformer of CRA-PCN.

Rong et al., CRA-PCN: Point Cloud Completion with Intra- and Inter-level
Cross-Resolution Transformers, AAAI 2024, section 3.3.
"""

import functools
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import three_point_interpolate
from prism_jax.models import layers
from prism_jax.models.config import BackboneConfig
from prism_jax.models.pyramid import Pyramid

interpolate = layers.over_batch(three_point_interpolate)


class Cloud(NamedTuple):
    """Points and their features."""

    xyz: Float[Array, "... N 3"]
    features: Float[Array, "... N C"]

    def at(self, rows: Int[Array, "... M"]) -> "Cloud":
        """Some of them."""
        return Cloud(layers.take(self.xyz, rows), layers.take(self.features, rows))


class VectorAttention(nn.Module):
    """PointTransformer's attention, with one weight per channel: the query feature plus
    ``sum_k softmax(gamma(q - k + delta)) * (v + delta)``, delta the embedded offset."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self,
        query: Cloud,
        support: Cloud,
        neighbors: Int[Array, "... N k"],
        train: bool = False,
    ) -> Float[Array, "... N C"]:
        config = self.config
        logits, values = _logits_and_values(config, query, support, neighbors, train)
        logits = layers.Dense(config.attention_features, name="attention_1")(logits)
        attended = attend(logits, values)
        return layers.Dense(config.features, name="end")(attended) + query.features


class UpsamplingAttention(nn.Module):
    """Vector attention that splits each point in ``seed_times``, without a softmax
    (SeedFormer's upsample transformer, as CRA-PCN's seed generator uses it)."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self,
        cloud: Cloud,
        neighbors: Int[Array, "... N k"],
        train: bool = False,
    ) -> Float[Array, "... M D"]:
        config, times = self.config, self.config.seed_times
        logits, values = _logits_and_values(config, cloud, cloud, neighbors, train)
        # The kernel runs over the points: (..., N, k, C) -> (..., k, N * times, D).
        split = layers.SplitPoints(config.attention_features, times, name="attention_1")
        weights = split(jnp.swapaxes(logits, -3, -2))
        values = layers.repeat_in_place(jnp.swapaxes(values, -3, -2), times)
        attended = (weights * values).sum(-3)
        residual = layers.Dense(config.features, name="residual")(cloud.features)
        end = layers.Dense(config.features, name="end")(attended)
        return end + layers.repeat_in_place(residual, times)


def _logits_and_values(
    config: BackboneConfig,
    query: Cloud,
    support: Cloud,
    neighbors: Array,
    train: bool,
) -> tuple[Array, Array]:
    """`hidden_and_values` of points and features; submodules belong to the caller."""
    dense = functools.partial(layers.Dense, config.attention_features)
    queries = query.xyz, dense(name="query")(query.features)
    key, value = (dense(name=name)(support.features) for name in ("key", "value"))
    supports = support.xyz, key, value
    return hidden_and_values(queries, supports, neighbors, config, train)


def hidden_and_values(
    queries: tuple[Float[Array, "... N 3"], Float[Array, "... N C"]],
    supports: tuple[
        Float[Array, "... M 3"], Float[Array, "... M C"], Float[Array, "... M C"]
    ],
    neighbors: Int[Array, "... N k"],
    config: Any,
    train: bool,
) -> tuple[Float[Array, "... N k H"], Float[Array, "... N k C"]]:
    """The hidden attention layer and ``v + delta``, for each query and neighbour, of
    queries ``(xyz, q)`` and supports ``(xyz, k, v)``. The submodules made here belong
    to the compact module that calls it."""
    (query_xyz, query), (support_xyz, key, value) = queries, supports
    width = query.shape[-1]
    position = layers.Dense(width, name="position_0")

    # The first layer of the offset is linear: applied to points, before they are
    # gathered. The barrier keeps XLA from fusing the concatenation into the gather.
    support = [key, position(support_xyz, bias=False), value]
    support = jax.lax.optimization_barrier(jnp.concatenate(support, axis=-1))
    key, offset, value = jnp.split(layers.take(support, neighbors), 3, -1)
    offset = position(query_xyz)[..., None, :] - offset
    if config.use_norm:
        offset = layers.batch_norm(train, "position_norm")(offset)
    embedding = layers.Dense(width, name="position_1")(nn.relu(offset))
    hidden = layers.Dense(config.attention_ratio * width, name="attention_0")
    logits = hidden(query[..., None, :] - key + embedding)
    if config.use_norm:
        logits = layers.batch_norm(train)(logits)
    return nn.relu(logits), value + embedding


@jax.custom_jvp
def attend(
    logits: Float[Array, "... k C"], values: Float[Array, "... k C"]
) -> Float[Array, "... C"]:
    """``sum_k softmax(logits) * values``, channel by channel: over the few neighbours
    one by one, and with its own derivative, since CPUs reduce inner axes slowly."""
    exponents, total = _exponents(logits)
    products = [e * v for e, v in zip(exponents, _neighbors(values), strict=True)]
    return functools.reduce(jnp.add, products) / total


@attend.defjvp
def _attend_jvp(primals, tangents):
    logits, values = primals
    logits_dot, values_dot = tangents
    attended = attend(logits, values)
    exponents, total = _exponents(logits)
    weights = jnp.stack([e / total for e in exponents], axis=-2)
    centered = values - attended[..., None, :]
    return attended, (weights * (values_dot + centered * logits_dot)).sum(-2)


def _exponents(logits: Array) -> tuple[list[Array], Array]:
    each = _neighbors(logits)
    highest = jax.lax.stop_gradient(functools.reduce(jnp.maximum, each))
    exponents = [jnp.exp(logit - highest) for logit in each]
    return exponents, functools.reduce(jnp.add, exponents)


def _neighbors(pairs: Array) -> list[Array]:
    return [pairs[..., i, :] for i in range(pairs.shape[-2])]


class CrossResolutionTransformer(nn.Module):
    """Attention from the coarsest resolution to the finest: each coarser result is
    interpolated to the next and joined to the features of both clouds there."""

    config: BackboneConfig

    @nn.compact
    def __call__(
        self,
        query: Cloud,
        support: Cloud,
        pyramid: Pyramid,
        train: bool = False,
    ) -> Float[Array, "... N C"]:
        coarser = query
        for i in reversed(range(len(pyramid))):
            level = pyramid[i]
            q, s = query.at(level.query_rows), support.at(level.support_rows)
            if level.query_coarser is not None:
                q = self._join(f"query_{i}", q, coarser, level.query_coarser)
                s = self._join(f"support_{i}", s, coarser, level.support_coarser)
            attention = VectorAttention(self.config, name=f"attention_{i}")
            coarser = Cloud(q.xyz, attention(q, s, level.neighbors, train))
        return coarser.features

    def _join(self, name: str, cloud: Cloud, coarser: Cloud, nearest: Any) -> Cloud:
        width = self.config.features
        join = layers.ResidualMLP(width, width, name=name)
        raised = interpolate(cloud.xyz, *coarser, nearest)
        return Cloud(cloud.xyz, join(cloud.features, raised))
