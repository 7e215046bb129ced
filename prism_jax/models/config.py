"""Sizes of the networks. Frozen and hashable, so static under ``jit``."""

import dataclasses
from typing import Literal

from prism_jax.geometry.visibility import Background
from prism_jax.models.ranges import check_ranges

MAX_POINTS = 2**18
"""Of a cloud that the decoder makes."""

MAX_POSES = 4
"""Of `prism_jax.models.poses`."""

WIDTHS = (1, 4096)
NEIGHBORS = (1, 64)


@dataclasses.dataclass(frozen=True)
class BackboneConfig:
    """CRA-PCN. The defaults are the published network for PCN.

    Attributes:
      num_points: points of the partial cloud.
      patch_points: points left by the two set abstractions.
      patch_features: hidden and output widths of the two set abstractions.
      global_features: hidden and output widths of the global feature.
      patch_neighbors: neighbours in set abstractions and in the seed generator.
      features: width of per-point features in the transformers.
      attention_features: width inside an attention.
      attention_ratio: expansion of its hidden layer.
      num_neighbors: neighbours per resolution, finest first.
      encoder_rates: resolutions of the encoder's transformers, as divisors.
      level_rates: the same for each up-sampling block.
      seed_times: seeds per patch point.
      seeds_from_patches: seeds are offsets from their patch points, and not absolute
        coordinates as published; a short training gets further so.
      num_initial: points sampled from seeds and partial, from which refinement starts.
      up_factors: children per point of each up-sampling block.
      use_norm: BatchNorm in the attentions and the up-sampling heads.
      offset_init: standard deviation of the kernels that make coordinate offsets; a
        small one starts training from the seeds and the partial themselves.
      offset_reach: how far a child can lie from its parent along each axis, at the
        most, in half sides of the workspace. Where truth goes on beyond what is
        measured, blocks that can reach far throw single points after it instead of
        leaving that to the seeds.
      reads_visibility: every block reads, for each of its points, what the sensor knows
        there (`prism_jax.geometry.visibility.clues`). The paper's decoder does not.
      seeds_read_visibility: the global feature, and so the seeds, read it too, at a
        lattice of points in and around the workspace. Needs `reads_visibility`.
      reads_depth: every block reads, for each of its points, the depth stream's feature
        maps at its projection (`prism_jax.models.depth_encoder.aligned`). In the paper
        the streams meet in the losses alone.
    """

    num_points: int = 2048
    patch_points: tuple[int, int] = (512, 128)
    patch_features: tuple[tuple[int, int], tuple[int, int]] = ((64, 128), (128, 256))
    global_features: tuple[int, int] = (512, 512)
    patch_neighbors: int = 16
    features: int = 128
    attention_features: int = 64
    attention_ratio: int = 4
    num_neighbors: tuple[int, ...] = (16, 12, 8)
    encoder_rates: tuple[int, ...] = (1, 2, 4)
    level_rates: tuple[tuple[int, ...], ...] = ((1, 2, 4), (1, 2, 4), (1, 4, 8))
    seed_times: int = 2
    seeds_from_patches: bool = False
    num_initial: int = 512
    up_factors: tuple[int, ...] = (1, 4, 8)
    use_norm: bool = True
    offset_init: float = 0.01
    offset_reach: float = 1.0
    reads_visibility: bool = False
    seeds_read_visibility: bool = False
    reads_depth: bool = False

    def __post_init__(self):
        check_ranges(
            self,
            num_points=(1, 2**16),
            patch_points=(1, 2**16),
            patch_features=WIDTHS,
            global_features=WIDTHS,
            patch_neighbors=NEIGHBORS,
            features=WIDTHS,
            attention_features=WIDTHS,
            attention_ratio=(1, 64),
            num_neighbors=NEIGHBORS,
            encoder_rates=(1, 256),
            level_rates=(1, 256),
            seed_times=(1, 256),
            num_initial=(1, 2**16),
            up_factors=(1, 256),
            offset_init=(0, 1e3),
            offset_reach=(1e-6, 1e3),
        )
        if self.seeds_read_visibility and not self.reads_visibility:
            raise ValueError("seeds_read_visibility needs reads_visibility")
        if max(self.stage_sizes) > MAX_POINTS:
            raise ValueError(f"a stage must not have over {MAX_POINTS:,} points")

    @property
    def num_seeds(self) -> int:
        return self.patch_points[1] * self.seed_times

    @property
    def stage_sizes(self) -> tuple[int, ...]:
        """Points of every stage, seeds first."""
        sizes, current = [self.num_seeds], self.num_initial
        for factor in self.up_factors:
            current *= factor
            sizes.append(current)
        return tuple(sizes)


@dataclasses.dataclass(frozen=True)
class AuxiliaryConfig:
    """Depth stream, refiner and auxiliary branches. The defaults are the paper's sizes.

    Attributes:
      depth_features: widths of the ResNet's stages; each but the first halves the map.
      depth_blocks: residual blocks per stage.
      num_tokens: tokens that the token integrator makes of a cloud (m).
      token_features: width of the tokens of both streams (d).
      hidden: hidden width of the refiner, the normal head and the denoiser.
      max_offset: bound on the refiner's offsets, delta_max of Eq. 2.
      max_coordinate: bound on refined coordinates. Eq. 2 has 1, which holds everything
        where the complete cloud places the workspace; where the partial does, some of
        the shape lies outside.
      denoise_neighbors: neighbours that the denoiser sees of a point.
    """

    depth_features: tuple[int, ...] = (64, 128, 256, 512)
    depth_blocks: int = 2
    num_tokens: int = 64
    token_features: int = 256
    hidden: int = 128
    max_offset: float = 0.1
    max_coordinate: float = 1.0
    denoise_neighbors: int = 8

    def __post_init__(self):
        check_ranges(
            self,
            depth_features=WIDTHS,
            depth_blocks=(1, 16),
            num_tokens=WIDTHS,
            token_features=WIDTHS,
            hidden=WIDTHS,
            max_offset=(0, 1e3),
            max_coordinate=(0, 1e3),
            denoise_neighbors=NEIGHBORS,
        )


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The whole of PRISM's networks, and the frame that they work in.

    Attributes:
      margin: side of the workspace over the longest side of the partial's box.
      heading: "level" if the workspace is turned about the vertical as
        `prism_jax.observation.heading` says, in training and afterwards; "given" if the
        weights know objects with their front along y, and get them as they come.
      depth_pixels: side of the depth map that the depth stream reads.
      consistency_pixels: side of the maps that Eq. 3 and Eq. 4 compare: few points
        leave holes in a fine map, through which the far side of the shape shows.
      background: what lies around a cloud that comes without a map, for a network that
        reads visibility.
      told: whether such a network is told what else the sensor measured in the same
        scan, where that is known. Chosen on validation, for each set of weights.
      poses: in how many poses a frame is completed, of those of
        `prism_jax.models.poses`; what comes of each is laid together. Training looks
        at one.
    """

    backbone: BackboneConfig = BackboneConfig()
    auxiliary: AuxiliaryConfig = AuxiliaryConfig()
    margin: float = 1.4
    heading: Literal["given", "level"] = "given"
    depth_pixels: int = 128
    consistency_pixels: int = 128
    background: Background = "unknown"
    told: bool = False
    poses: int = 1

    def __post_init__(self):
        pixels = (1, 2048)
        check_ranges(
            self,
            margin=(0.1, 100),
            depth_pixels=pixels,
            consistency_pixels=pixels,
            poses=(1, MAX_POSES),
        )

    @property
    def num_points(self) -> int:
        """That a completion has."""
        return self.poses * self.backbone.stage_sizes[-1]


SHAPENET55 = BackboneConfig(up_factors=(1, 4, 4))
"""The published CRA-PCN variant for ShapeNet-55: 256 / 512 / 2,048 / 8,192 points."""

PCN = BackboneConfig()
"""The published CRA-PCN variant for PCN: 256 / 512 / 2,048 / 16,384 points."""
