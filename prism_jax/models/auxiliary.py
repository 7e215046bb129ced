"""The refiner, and auxiliary branches: tokens of both streams, normals, denoising."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.encoder import PointFeatures
from prism_jax.models.layers import MLP, Dense, highest, take


class Refiner(nn.Module):
    """Eq. 2: ``clamp(c + delta_max * tanh(g(c, phi)), -1, 1)``, or another bound. It
    starts as the identity: features may be large, and so random offsets."""

    config: AuxiliaryConfig

    @nn.compact
    def __call__(
        self, points: Float[Array, "... N 3"], features: Float[Array, "... N C"]
    ) -> Float[Array, "... N 3"]:
        init = nn.initializers.zeros
        g = MLP((self.config.hidden, 3), final_init=init, name="g")(points, features)
        refined = points + self.config.max_offset * jnp.tanh(g)
        bound = self.config.max_coordinate
        return jnp.clip(refined, -bound, bound)


class TokenIntegrator(nn.Module):
    """I_TSI: learned queries, shifted by the global feature, look at the patches. Gives
    the point stream as m tokens, and one latent vector of all of them. Normalised over
    channels and not over a batch, so that one frame will do."""

    config: AuxiliaryConfig

    @nn.compact
    def __call__(
        self, encoded: PointFeatures
    ) -> tuple[Float[Array, "... m d"], Float[Array, "... d"]]:
        width = self.config.token_features
        init = nn.initializers.normal(1.0)
        queries = self.param("queries", init, (self.config.num_tokens, width))
        context = Dense(width, name="context")(encoded.global_feature)
        queries = _normalised(queries + context[..., None, :])
        patches = jnp.concatenate([encoded.patch_xyz, encoded.patch_features], -1)
        keys = Dense(width, name="key")(patches)
        values = Dense(width, name="value")(patches)
        logits = jnp.einsum("...md,...nd->...mn", queries, keys) / width**0.5
        attended = jax.nn.softmax(logits, axis=-1) @ values
        tokens = attended + MLP((width, width), name="mlp")(_normalised(attended))
        tokens = _normalised(tokens + context[..., None, :])
        return tokens, Dense(width, name="latent")(tokens.mean(-2))


class DepthProjection(nn.Module):
    """The depth stream's tokens, brought to the width of the point stream's."""

    config: AuxiliaryConfig

    @nn.compact
    def __call__(self, tokens: Float[Array, "... n C"]) -> Float[Array, "... n d"]:
        width = self.config.token_features
        projected = Dense(width, name="token")(tokens)
        context = Dense(width, name="context")(tokens.mean(-2))
        return _normalised(projected + context[..., None, :])


class NormalHead(nn.Module):
    """Unit normals of completed points, from place and decoder feature (gap 13)."""

    config: AuxiliaryConfig

    @nn.compact
    def __call__(
        self, points: Float[Array, "... N 3"], features: Float[Array, "... N C"]
    ) -> Float[Array, "... N 3"]:
        hidden = self.config.hidden
        normals = MLP((hidden, hidden, 3), name="mlp")(points, features)
        # The floor keeps the derivative finite where the head returns zero.
        return normals * jax.lax.rsqrt((normals**2).sum(-1, keepdims=True) + 1e-8)


class Denoiser(nn.Module):
    """Offsets that undo a perturbation of the partial cloud (Eq. 6). Each point sees
    its offsets to its neighbours and the latent of the whole cloud."""

    config: AuxiliaryConfig

    @nn.compact
    def __call__(
        self,
        perturbed: Float[Array, "... N 3"],
        neighbors: Int[Array, "... N k"],
        latent: Float[Array, "... d"],
    ) -> Float[Array, "... N 3"]:
        hidden = self.config.hidden
        offsets = take(perturbed, neighbors) - perturbed[..., None, :]
        local = highest(MLP((hidden // 2, hidden), name="local")(offsets))
        init = nn.initializers.normal(0.01)
        mlp = MLP((hidden, hidden, 3), final_init=init, name="mlp")
        return mlp(perturbed, local, latent[..., None, :])


def _normalised(tokens: Array) -> Array:
    """Zero mean and unit variance over the channels, without parameters."""
    centered = tokens - tokens.mean(-1, keepdims=True)
    variance = (centered**2).mean(-1, keepdims=True)
    return centered * jax.lax.rsqrt(variance + 1e-5)
