"""PCN: one feature of the whole partial, coarse points from it, and a small grid folded
around each of them.

Yuan, Khot, Held, Mertz and Hebert, "PCN: Point Completion Network", 3DV 2018, sections
4.1 (encoder) and 4.2 (decoder); sizes as in the authors' released code, `pcn_cd`.
"""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.models.layers import MLP, highest, repeat_in_place


@dataclasses.dataclass(frozen=True)
class PCNConfig:
    """Sizes of PCN. The defaults are the published network.

    Attributes:
      num_points: points of the partial cloud that it is trained with; it takes any.
      local_features: widths of the MLP over single points.
      global_features: widths of the MLP over points that know of all the others; the
        last is the width of the global feature.
      coarse_features: hidden widths of the MLP that makes the coarse points.
      num_coarse: coarse points.
      fold_features: hidden widths of the MLP that folds the grid.
      grid_size: points along a side of the grid.
      grid_extent: half of the grid's side, in the units of the cloud.
    """

    num_points: int = 2048
    local_features: tuple[int, ...] = (128, 256)
    global_features: tuple[int, ...] = (512, 1024)
    coarse_features: tuple[int, ...] = (1024, 1024)
    num_coarse: int = 1024
    fold_features: tuple[int, ...] = (512, 512)
    grid_size: int = 4
    grid_extent: float = 0.05

    @property
    def num_outputs(self) -> int:
        """Points of the dense stage."""
        return self.num_coarse * self.grid_size**2


PCN_SMALL = PCNConfig(
    num_points=512,
    local_features=(64, 128),
    global_features=(256, 512),
    coarse_features=(512, 512),
    num_coarse=128,
    fold_features=(256, 256),
)
"""512 points in, 128 and 2,048 out: every hidden width halved, 1,127,427 parameters."""


class PCN(nn.Module):
    """The coarse and the dense points of a partial cloud in the unit workspace.

    The result does not depend on the order of the partial's points, nor on how often
    one is there. The children of a coarse point follow each other in the dense stage.
    Differentiable in the parameters and the partial. An empty cloud raises ValueError;
    NaN coordinates give NaN. There is nothing that `train` changes.

    6,861,059 parameters with the default config, as many as the authors' code makes.
    Deviations: kernels start from LeCun's normal distribution instead of Glorot's
    uniform one. Training, which is not part of this module, sums the Chamfer distances
    of both stages, each to as many points of the complete cloud; the authors compare
    both with all of it, let the weight of the dense stage grow from 0.01 to 1, and give
    the network 3,000 points.
    """

    config: PCNConfig = PCNConfig()

    @nn.compact
    def __call__(
        self, partial: Float[Array, "*batch N 3"], train: bool = False
    ) -> tuple[Float[Array, "*batch C 3"], Float[Array, "*batch M 3"]]:
        if partial.shape[-2] == 0:
            raise ValueError("an empty cloud cannot be completed")
        config = self.config
        points = MLP(config.local_features, name="local")(partial)
        of_all = highest(points)[..., None, :]
        points = MLP(config.global_features, name="global")(points, of_all)
        feature = highest(points)[..., None, :]

        widths = (*config.coarse_features, 3 * config.num_coarse)
        coarse = MLP(widths, name="coarse")(feature)
        coarse = coarse.reshape(*partial.shape[:-2], config.num_coarse, 3)

        grid = folding_grid(config.grid_size, config.grid_extent)
        grid = jnp.tile(grid, (config.num_coarse, 1))
        offsets = MLP((*config.fold_features, 3), name="fold")(grid, coarse, feature)
        return coarse, repeat_in_place(coarse, config.grid_size**2) + offsets


def folding_grid(size: int, extent: float) -> Float[Array, "n 2"]:
    """The square grid around the origin that every coarse point has of its own."""
    side = jnp.linspace(-extent, extent, size)
    return jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2)
