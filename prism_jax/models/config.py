"""Sizes of the networks. Frozen and hashable, so static under ``jit``."""

import dataclasses
from typing import Annotated, Literal

from prism_jax.geometry.visibility import Background
from prism_jax.geometry.workspace import CUBE_MARGIN
from prism_jax.models.ranges import Checked

MAX_POINTS = 2**18  # of a cloud that the decoder makes

MAX_POSES = 3  # of `prism_jax.models.poses`

Points = Annotated[int, 1, 2**16]
Width = Annotated[int, 1, 4096]
Neighbors = Annotated[int, 1, 64]
Rate = Annotated[int, 1, 256]
Pixels = Annotated[int, 1, 2048]
Length = Annotated[float, 0, 1e3]


@dataclasses.dataclass(frozen=True)
class BackboneConfig(Checked):
    """CRA-PCN. The defaults are the published network for PCN."""

    # Points of the partial cloud.
    num_points: Points = 2048
    # Points left by the two set abstractions, and their hidden and output widths.
    patch_points: Annotated[tuple[int, int], 1, 2**16] = (512, 128)
    patch_features: Annotated[tuple[tuple[int, int], tuple[int, int]], 1, 4096] = (
        (64, 128),
        (128, 256),
    )
    # Hidden and output widths of the global feature.
    global_features: Annotated[tuple[int, int], 1, 4096] = (512, 512)
    # Neighbours in set abstractions and in the seed generator.
    patch_neighbors: Neighbors = 16
    # Width of per-point features in the transformers.
    features: Width = 128
    # Width inside an attention, and expansion of its hidden layer.
    attention_features: Width = 64
    attention_ratio: Neighbors = 4
    # Neighbours per resolution, finest first.
    num_neighbors: Annotated[tuple[int, ...], 1, 64] = (16, 12, 8)
    # Resolutions as divisors, of the encoder's transformers and of each block's.
    encoder_rates: Annotated[tuple[int, ...], 1, 256] = (1, 2, 4)
    level_rates: Annotated[tuple[tuple[int, ...], ...], 1, 256] = (
        (1, 2, 4),
        (1, 2, 4),
        (1, 4, 8),
    )
    # Seeds per patch point.
    seed_times: Rate = 2
    # Whether seeds are offsets from their patch points; as published they are absolute.
    seeds_from_patches: bool = False
    # Points sampled from seeds and partial, from which refinement starts.
    num_initial: Points = 512
    # Children per point of each up-sampling block.
    up_factors: Annotated[tuple[int, ...], 1, 256] = (1, 4, 8)
    # Whether attentions and up-sampling heads have BatchNorm.
    use_norm: bool = True
    # Of the kernels that make offsets; small, so that training starts from the seeds.
    offset_init: Length = 0.01
    # How far a child can lie from its parent along each axis, in half sides.
    offset_reach: Annotated[float, 1e-6, 1e3] = 1.0
    # Whether blocks read, for each point, what `visibility_features` says of it.
    reads_visibility: bool = False
    # Whether the global feature, and so the seeds, read it too, at a lattice of points.
    seeds_read_visibility: bool = False

    def __post_init__(self):
        super().__post_init__()
        if self.seeds_read_visibility and not self.reads_visibility:
            raise ValueError("seeds_read_visibility needs reads_visibility")
        if max(self.stage_sizes) > MAX_POINTS:
            raise ValueError(f"a stage must not have over {MAX_POINTS:,} points")

    @property
    def stage_sizes(self) -> tuple[int, ...]:
        """Points of every stage, seeds first."""
        sizes, current = [self.patch_points[1] * self.seed_times], self.num_initial
        for factor in self.up_factors:
            current *= factor
            sizes.append(current)
        return tuple(sizes)


@dataclasses.dataclass(frozen=True)
class AuxiliaryConfig(Checked):
    """Depth stream, refiner and auxiliary branches. The defaults are the paper's."""

    # Widths of the ResNet's stages; each but the first halves the map.
    depth_features: Annotated[tuple[int, ...], 1, 4096] = (64, 128, 256, 512)
    # Residual blocks per stage.
    depth_blocks: Annotated[int, 1, 16] = 2
    # Tokens of a cloud (m), and the width of those of both streams (d).
    num_tokens: Width = 64
    token_features: Width = 256
    # Hidden width of the refiner, the normal head and the denoiser.
    hidden: Width = 128
    # Bound on the refiner's offsets, delta_max of Eq. 2.
    max_offset: Length = 0.1
    # Bound on refined coordinates. Eq. 2 has 1; where the partial alone places the
    # workspace, some of the shape lies outside.
    max_coordinate: Length = 1.0
    # Neighbours that the denoiser sees of a point.
    denoise_neighbors: Neighbors = 8


@dataclasses.dataclass(frozen=True)
class ModelConfig(Checked):
    """The whole of PRISM's networks, and the frame that they work in."""

    backbone: BackboneConfig = BackboneConfig()
    auxiliary: AuxiliaryConfig = AuxiliaryConfig()
    # Side of the workspace over the longest side of the partial's box.
    margin: Annotated[float, 0.1, 100] = CUBE_MARGIN
    # "level": objects are turned as `prism_jax.preprocessing.heading` says. "given":
    # they come with their front along y.
    heading: Literal["given", "level"] = "given"
    # Side of the depth map that the depth stream reads.
    depth_pixels: Pixels = 128
    # Side of the maps of Eq. 3 and 4. Few points leave holes in a fine one.
    consistency_pixels: Pixels = 128
    # What lies around a cloud that comes without a map, for a network that reads one.
    background: Background = "unknown"
    # Whether such a network is given what else the sensor measured in the same scan.
    uses_visibility: bool = False
    # How many of `prism_jax.models.poses` a frame is completed in; training takes one.
    poses: Annotated[int, 1, MAX_POSES] = 1

    @property
    def num_points(self) -> int:
        """That a completion has."""
        return self.poses * self.backbone.stage_sizes[-1]
