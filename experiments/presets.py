"""Named configurations."""

import dataclasses
from typing import Annotated

from prism_jax.adaptation.config import AdaptConfig, MetaConfig, PrismConfig
from prism_jax.models.config import AuxiliaryConfig, BackboneConfig, ModelConfig
from prism_jax.models.ranges import Checked
from prism_jax.training.config import MetaTrainConfig, PhaseConfig, PretrainConfig


@dataclasses.dataclass(frozen=True)
class Preset(Checked):
    """Everything that a run depends on, apart from its seed."""

    # The networks, and how they adapt to a frame.
    model: ModelConfig
    adapt: AdaptConfig
    # How they are trained first, and how they then learn to adapt.
    pretrain: PretrainConfig
    meta: MetaTrainConfig
    # Procedural shapes that are built for it alone, or 0 for the corpus that all share.
    num_shapes: Annotated[int, 0, 10**9] = 0

    @property
    def config(self) -> PrismConfig:
        """What its weights are used with."""
        return PrismConfig(self.model, self.adapt)


_SMALL = BackboneConfig(
    num_points=512,
    patch_points=(256, 64),
    patch_features=((32, 64), (64, 128)),
    global_features=(256, 256),
    patch_neighbors=8,
    features=64,
    attention_features=32,
    attention_ratio=2,
    num_neighbors=(8, 8),
    encoder_rates=(1, 4),
    level_rates=((1, 4), (1, 4)),
    seeds_from_patches=True,
    num_initial=256,
    up_factors=(1, 8),
    use_norm=False,
    offset_reach=0.2,
    reads_visibility=True,
    seeds_read_visibility=True,
)

_SMALL_AUXILIARY = AuxiliaryConfig(
    depth_features=(16, 32, 64, 64),
    depth_blocks=1,
    num_tokens=16,
    token_features=64,
    hidden=64,
    max_coordinate=2.0,
)

_PAPER = BackboneConfig(seed_times=8, num_initial=2048, up_factors=(1, 2, 4))

_TINY = BackboneConfig(
    num_points=64,
    patch_points=(32, 16),
    patch_features=((8, 16), (16, 16)),
    global_features=(16, 16),
    patch_neighbors=4,
    features=16,
    attention_features=8,
    attention_ratio=2,
    num_neighbors=(4, 4),
    encoder_rates=(1, 2),
    level_rates=((1, 2), (1, 2)),
    num_initial=32,
    up_factors=(1, 2),
)

_TINY_AUXILIARY = AuxiliaryConfig(
    depth_features=(4, 8),
    depth_blocks=1,
    num_tokens=4,
    token_features=8,
    hidden=8,
    denoise_neighbors=4,
)


def _phases(seeds: int, stages: int) -> tuple[PhaseConfig, ...]:
    """Seeds alone, then the whole decoder."""
    first = PhaseConfig("seeds", seeds, num_blocks=0, final_rate=0.5)
    return first, PhaseConfig("stages", stages, num_blocks=None)


_SMALL_ADAPT = AdaptConfig(num_steps=1, step_size=3e-2, clip_norm=1.0, normal_stride=4)

# At a constant step size for as long as that helps, then to its end.
_SMALL_PRETRAIN = PretrainConfig(
    (
        PhaseConfig("stages", 2_400_000, None, final_rate=1.0, patience=320_000),
        PhaseConfig("anneal", 400_000, None),
    ),
    auxiliary_samples=20_000,
    optimiser="muon",
    average_decay=0.999,
    validate_every=64_000,
)

# It differs from the paper's method. The encoders have no auxiliary loss in the outer
# loop (lambda_aux=0). The loss weights learn from the adapted completion and not from
# the weighted loss itself ("meta"). The inner loop descends exactly what test time
# descends. Step sizes and auxiliary modules are learned, and the refiner stays.
_SMALL_META = MetaTrainConfig(
    MetaConfig(
        lambda_aux=0.0,
        weight_rule="meta",
        rehearse_depth=True,
        learn_steps=True,
        learn_auxiliary=True,
        learn_refiner=False,
    ),
    num_samples=32_000,
    at_once=8,
    num_complete=2048,
    optimiser="adam",
    learning_rate=1e-4,
    final_rate=0.01,
    warmup_steps=50,
    clip_norm=1.0,
    weight_rate=1e-2,
    step_rate=2e-2,
    auxiliary_rate=3e-3,
    average_decay=0.99,
    validate_every=4_000,
)

_PAPER_PRETRAIN = PretrainConfig(
    _phases(2_000_000, 8_000_000), auxiliary_samples=500_000, num_complete=16_384
)

_PAPER_META = MetaTrainConfig(MetaConfig(remat=True), at_once=4)

PRESETS = {
    "tiny": Preset(
        ModelConfig(_TINY, _TINY_AUXILIARY, depth_pixels=32, consistency_pixels=16),
        AdaptConfig(normal_neighbors=4),
        PretrainConfig(
            _phases(64, 64),
            auxiliary_samples=64,
            batch_size=8,
            num_complete=128,
            validate_every=32,
        ),
        MetaTrainConfig(
            num_samples=128, batch_size=8, num_complete=128, validate_every=32
        ),
        num_shapes=64,
    ),
    "small": Preset(
        ModelConfig(
            _SMALL,
            _SMALL_AUXILIARY,
            heading="level",
            consistency_pixels=32,
            uses_visibility=True,
            poses=3,
        ),
        _SMALL_ADAPT,
        _SMALL_PRETRAIN,
        _SMALL_META,
    ),
    "paper": Preset(ModelConfig(_PAPER), AdaptConfig(), _PAPER_PRETRAIN, _PAPER_META),
}
