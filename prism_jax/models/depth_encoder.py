"""The depth stream: a ResNet over the projected depth, without a decoder."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.layers import Conv, batch_norm


class DepthEncoder(nn.Module):
    """ResNet (He et al., CVPR 2016) of a depth map, in workspace units relative to the
    workspace's centre, and its mask; where that is False, depth has no influence. The
    last feature map's cells are its tokens."""

    config: AuxiliaryConfig

    @nn.compact
    def __call__(
        self,
        depth: Float[Array, "... H W"],
        mask: Bool[Array, "... H W"],
        train: bool = False,
    ) -> Float[Array, "... n C"]:
        seen = jnp.where(mask, depth, 0.0)
        x = jnp.stack([seen, mask.astype(seen.dtype)], axis=-1)
        first = self.config.depth_features[0]
        x = Conv(first, 7, 2, name="stem")(x)
        x = nn.relu(batch_norm(train)(x))
        x = nn.max_pool(x, (3, 3), strides=(2, 2), padding="SAME")
        for stage, features in enumerate(self.config.depth_features):
            for block in range(self.config.depth_blocks):
                strides = 2 if stage > 0 and block == 0 else 1
                name = f"stage_{stage}_block_{block}"
                x = ResidualBlock(features, strides, name=name)(x, train)
        return x.reshape(*x.shape[:-3], -1, x.shape[-1])


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut."""

    features: int
    strides: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "... H W C"], train: bool
    ) -> Float[Array, "... H2 W2 D"]:
        y = self._convolve(x, 3, self.strides, "conv_0", train)
        y = self._convolve(nn.relu(y), 3, 1, "conv_1", train)
        if x.shape != y.shape:
            x = self._convolve(x, 1, self.strides, "shortcut", train)
        return nn.relu(x + y)

    def _convolve(
        self, x: Array, size: int, strides: int, name: str, train: bool
    ) -> Array:
        x = Conv(self.features, size, strides, name=name)(x)
        return batch_norm(train, f"{name}_norm")(x)
