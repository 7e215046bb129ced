"""What a training does, in frozen dataclasses."""

import dataclasses
from typing import Literal

from prism_jax.adaptation.config import MetaConfig
from prism_jax.losses.chamfer import ChamferNorm
from prism_jax.models.ranges import check_ranges

SAMPLES = (0, 10**12)
RATE = (0, 1e3)


@dataclasses.dataclass(frozen=True)
class PhaseConfig:
    """One phase of pretraining the backbone.

    Attributes:
      name: what the log and the checkpoints call it.
      num_samples: examples seen, repetitions counted.
      num_blocks: up-sampling blocks trained: 0 for encoder and seeds alone, None for
        all.
      learning_rate: Adam's step size after the warm-up; it falls along a cosine.
      final_rate: where the cosine ends, as a share of learning_rate.
      first_block: up-sampling blocks before it stay as they are, and so do encoder and
        seeds: a last stage is trained alone. 0 for none.
    """

    name: str
    num_samples: int
    num_blocks: int | None
    learning_rate: float = 1e-3
    final_rate: float = 0.01
    first_block: int = 0

    def __post_init__(self):
        check_ranges(
            self,
            num_samples=SAMPLES,
            num_blocks=(0, 8),
            learning_rate=RATE,
            final_rate=(0, 1),
            first_block=(0, 8),
        )


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """Stage A: what makes weights for meta-training to start from (gap 4).

    Attributes:
      backbone: phases on Eq. 10, coarse stages first.
      auxiliary_samples: examples for the refiner (Eq. 3), the depth encoder and the
        auxiliary heads, on the finished backbone.
      auxiliary_rate: Adam's step size for those.
      batch_size: examples a step.
      num_complete: points of the complete cloud that a loss looks at.
      norm: Chamfer convention of Eq. 10 in training: CD-L1, while validation and all
        scores are CD-L2.
      warmup_steps: steps in which the step size rises from zero.
      clip_norm: bound on the gradient's global norm; 0 for none.
      average_decay: of the moving average of the backbone's variables, which is then
        what is validated and kept; 0 for none.
      validate_every: samples between validations.
    """

    backbone: tuple[PhaseConfig, ...]
    auxiliary_samples: int
    auxiliary_rate: float = 1e-3
    batch_size: int = 32
    num_complete: int = 2048
    norm: ChamferNorm = "l1"
    warmup_steps: int = 200
    clip_norm: float = 1.0
    average_decay: float = 0.0
    validate_every: int = 16_000

    def __post_init__(self):
        check_ranges(
            self,
            auxiliary_samples=SAMPLES,
            auxiliary_rate=RATE,
            batch_size=(1, 2**16),
            num_complete=(1, 2**20),
            warmup_steps=SAMPLES,
            clip_norm=(0, 1e6),
            average_decay=(0, 1),
            validate_every=SAMPLES,
        )


@dataclasses.dataclass(frozen=True)
class MetaTrainConfig:
    """Stage B: episodes of adaptation, with the paper's optimiser.

    Attributes:
      method: the meta-objective.
      num_samples: frames seen, repetitions counted.
      batch_size: frames a step, over all devices.
      at_once: frames that a device takes at once; gradients of the rest of its share
        are added up one part after the other, for memory. 0 for all.
      num_complete: points of the complete cloud that a loss looks at.
      optimiser: of encoders and decoder, "sgd" or "adam".
      learning_rate: of encoders and decoder, after the warm-up.
      final_rate: where its cosine ends, as a share of it; 1 for no cosine.
      warmup_steps: steps in which it rises from zero.
      clip_norm: bound on the global norm of their gradient; 0 for none.
      weight_rate: of the loss weights' logits, whose optimiser is of the same kind.
      step_rate: of the logarithms of learned step sizes, by Adam.
      auxiliary_rate: of the auxiliary modules and of the learned term, if they learn.
      refiner_rate: of the refiner, whose optimiser is its own, of the same kind.
      average_decay: of the moving average of all variables but the scales, which is
        then what is validated and released; 0 for none.
      validate_every: samples between validations.
    """

    method: MetaConfig = dataclasses.field(default_factory=MetaConfig)
    num_samples: int = 8_400_000
    batch_size: int = 32
    at_once: int = 0
    num_complete: int = 16_384
    optimiser: Literal["sgd", "adam"] = "sgd"
    learning_rate: float = 5e-5
    final_rate: float = 1.0
    warmup_steps: int = 0
    clip_norm: float = 0.0
    weight_rate: float = 5e-4
    step_rate: float = 1e-2
    auxiliary_rate: float = 1e-3
    refiner_rate: float = 5e-5
    average_decay: float = 0.0
    validate_every: int = 64_000

    def __post_init__(self):
        check_ranges(
            self,
            num_samples=SAMPLES,
            batch_size=(1, 2**16),
            at_once=(0, 2**16),
            num_complete=(1, 2**20),
            learning_rate=RATE,
            final_rate=(0, 1),
            warmup_steps=SAMPLES,
            clip_norm=(0, 1e6),
            weight_rate=RATE,
            step_rate=RATE,
            auxiliary_rate=RATE,
            refiner_rate=RATE,
            average_decay=(0, 1),
            validate_every=SAMPLES,
        )
