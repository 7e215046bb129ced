"""Vector attention and the cross-resolution transformer of CRA-PCN.

Rong et al., CRA-PCN: Point Cloud Completion with Intra- and Inter-level
Cross-Resolution Transformers, AAAI 2024, section 3.3.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import three_point_interpolate
from prism_jax.models.layers import (
    Dense,
    ResidualMLP,
    SplitPoints,
    batch_norm,
    gather,
    repeat_in_place,
    take,
)
from prism_jax.models.pyramid import Pyramid

interpolate = jnp.vectorize(
    three_point_interpolate, signature="(n,d),(m,d),(m,c),(n,k)->(n,c)"
)


class VectorAttention(nn.Module):
    """Attention over neighbours with one weight per channel.

    Of PointTransformer: ``sum_k softmax(gamma(q - k + delta)) * (v + delta)``, delta
    the embedded offset, plus the raw query feature.
    """

    features: int
    attention_features: int
    ratio: int
    use_norm: bool

    @nn.compact
    def __call__(
        self,
        query_xyz: Float[Array, "... N 3"],
        query_features: Float[Array, "... N C"],
        support_xyz: Float[Array, "... M 3"],
        support_features: Float[Array, "... M C"],
        neighbors: Int[Array, "... N k"],
        train: bool = False,
    ) -> Float[Array, "... N C"]:
        logits, values = _logits_and_values(
            self,
            (query_xyz, query_features, support_xyz, support_features),
            neighbors,
            train,
        )
        logits = Dense(self.attention_features, name="attention_1")(logits)
        attended = attend(logits, values)
        return Dense(self.features, name="end")(attended) + query_features


class UpsamplingAttention(nn.Module):
    """Vector attention that splits each point in ``times``, without a softmax
    (SeedFormer's upsample transformer, as CRA-PCN's seed generator uses it)."""

    features: int
    attention_features: int
    ratio: int
    times: int
    use_norm: bool

    @nn.compact
    def __call__(
        self,
        xyz: Float[Array, "... N 3"],
        features: Float[Array, "... N C"],
        neighbors: Int[Array, "... N k"],
        train: bool = False,
    ) -> Float[Array, "... M D"]:
        logits, values = _logits_and_values(
            self, (xyz, features, xyz, features), neighbors, train
        )
        # The kernel runs over the points: (..., N, k, C) -> (..., k, N * times, D).
        split = SplitPoints(self.attention_features, self.times, name="attention_1")
        weights = split(jnp.swapaxes(logits, -3, -2))
        values = repeat_in_place(jnp.swapaxes(values, -3, -2), self.times)
        attended = (weights * values).sum(-3)
        residual = Dense(self.features, name="residual")(features)
        end = Dense(self.features, name="end")(attended)
        return end + repeat_in_place(residual, self.times)


def _logits_and_values(
    module: VectorAttention | UpsamplingAttention,
    clouds: tuple[Array, Array, Array, Array],
    neighbors: Array,
    train: bool,
) -> tuple[Array, Array]:
    """`hidden_and_values` of features; submodules belong to the caller."""
    query_xyz, query_features, support_xyz, support_features = clouds
    width = module.attention_features
    query = Dense(width, name="query")(query_features)
    key = Dense(width, name="key")(support_features)
    value = Dense(width, name="value")(support_features)
    queries, supports = (query_xyz, query), (support_xyz, key, value)
    norm = module.use_norm
    return hidden_and_values(queries, supports, neighbors, module.ratio, norm, train)


def hidden_and_values(
    queries: tuple[Float[Array, "... N 3"], Float[Array, "... N C"]],
    supports: tuple[
        Float[Array, "... M 3"], Float[Array, "... M C"], Float[Array, "... M C"]
    ],
    neighbors: Int[Array, "... N k"],
    ratio: int,
    use_norm: bool,
    train: bool,
) -> tuple[Float[Array, "... N k H"], Float[Array, "... N k C"]]:
    """The hidden attention layer and ``v + delta``, for each query and neighbour.

    Of queries ``(xyz, q)`` and supports ``(xyz, k, v)``. To be called inside a compact
    module, to which the submodules made here belong.
    """
    (query_xyz, query), (support_xyz, key, value) = queries, supports
    width = query.shape[-1]
    position = Dense(width, name="position_0")

    # The first layer of the offset is linear: applied to points, before they are
    # gathered into k times as many pairs. One gather serves all, since its derivative
    # is one scatter; the barrier keeps XLA from fusing the concatenation into it.
    support = [key, position(support_xyz, bias=False), value]
    support = jax.lax.optimization_barrier(jnp.concatenate(support, axis=-1))
    key, offset, value = jnp.split(gather(support, neighbors), 3, -1)
    offset = position(query_xyz)[..., None, :] - offset
    if use_norm:
        offset = batch_norm(train, "position_norm")(offset)
    embedding = Dense(width, name="position_1")(nn.relu(offset))
    logits = Dense(ratio * width, name="attention_0")(
        query[..., None, :] - key + embedding
    )
    if use_norm:
        logits = batch_norm(train)(logits)
    return nn.relu(logits), value + embedding


@jax.custom_jvp
def attend(
    logits: Float[Array, "... k C"], values: Float[Array, "... k C"]
) -> Float[Array, "... C"]:
    """``sum_k softmax(logits) * values``, channel by channel.

    Written over the few neighbours one by one, and with its own derivative, so that
    neither pass reduces over an inner axis: on a CPU that is most of its time.
    """
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
    """Attention from the coarsest resolution to the finest.

    Each coarser result is interpolated to the next finer one and joined to the
    features of both clouds there.
    """

    features: int
    attention_features: int
    ratio: int
    use_norm: bool

    @nn.compact
    def __call__(
        self,
        query_xyz: Float[Array, "... N 3"],
        query_features: Float[Array, "... N C"],
        support_xyz: Float[Array, "... M 3"],
        support_features: Float[Array, "... M C"],
        pyramid: Pyramid,
        train: bool = False,
    ) -> Float[Array, "... N C"]:
        coarser_xyz = coarser = jnp.zeros(())
        for i in reversed(range(len(pyramid))):
            level = pyramid[i]
            q_xyz = take(query_xyz, level.query_rows)
            s_xyz = take(support_xyz, level.support_rows)
            q = take(query_features, level.query_rows)
            s = take(support_features, level.support_rows)
            if level.query_coarser is not None:
                raised = interpolate(q_xyz, coarser_xyz, coarser, level.query_coarser)
                q = self._join(f"query_{i}")(q, raised)
                raised = interpolate(s_xyz, coarser_xyz, coarser, level.support_coarser)
                s = self._join(f"support_{i}")(s, raised)
            attention = VectorAttention(
                self.features,
                self.attention_features,
                self.ratio,
                self.use_norm,
                name=f"attention_{i}",
            )
            coarser = attention(q_xyz, q, s_xyz, s, level.neighbors, train)
            coarser_xyz = q_xyz
        return coarser

    def _join(self, name: str) -> ResidualMLP:
        return ResidualMLP(self.features, self.features, name=name)
