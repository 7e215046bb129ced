"""Bounded refinement of the completed points."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.layers import MLP


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
