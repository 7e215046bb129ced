"""What a training does, in frozen dataclasses."""

import dataclasses
from typing import Annotated

from prism_jax.adaptation.config import MetaConfig
from prism_jax.losses.chamfer import ChamferNorm
from prism_jax.models.ranges import Checked
from prism_jax.training.optimisers import Kind

Samples = Annotated[int, 0, 10**12]
Rate = Annotated[float, 0, 1e3]
Share = Annotated[float, 0, 1]
Batch = Annotated[int, 1, 2**16]
Points = Annotated[int, 1, 2**20]
Norm = Annotated[float, 0, 1e6]


@dataclasses.dataclass(frozen=True)
class PhaseConfig(Checked):
    """One phase of pretraining the backbone."""

    # What the log and the checkpoints call it.
    name: str
    # Examples seen, repetitions counted.
    num_samples: Samples
    # Up-sampling blocks trained: 0 for encoder and seeds alone, None for all.
    num_blocks: Annotated[int | None, 0, 8]
    # Adam's step size after the warm-up. It falls along a cosine, to this share of it.
    learning_rate: Rate = 1e-3
    final_rate: Share = 0.01
    # It ends early after so many samples without a better validation; 0 for never.
    patience: Samples = 0


@dataclasses.dataclass(frozen=True)
class PretrainConfig(Checked):
    """Stage A: what makes weights for meta-training to start from (gap 4)."""

    # Phases on Eq. 10, coarse stages first.
    backbone: tuple[PhaseConfig, ...]
    # Examples for the refiner, the depth encoder and the branches; Adam's step size.
    auxiliary_samples: Samples
    auxiliary_rate: Rate = 1e-3
    # Of the backbone (`prism_jax.training.optimisers`).
    optimiser: Kind = "adam"
    # Examples a step.
    batch_size: Batch = 32
    # Points of the complete cloud that a loss looks at.
    num_complete: Points = 2048
    # Chamfer convention of Eq. 10 in training; validation and scores are in CD-L2.
    norm: ChamferNorm = "l1"
    # Steps in which the step size rises from zero.
    warmup_steps: Samples = 200
    # Bound on the gradient's global norm; 0 for none.
    clip_norm: Norm = 1.0
    # Of the moving average of the variables, which is then what is kept; 0 for none.
    average_decay: Share = 0.0
    # Samples between validations.
    validate_every: Samples = 16_000


@dataclasses.dataclass(frozen=True)
class MetaTrainConfig(Checked):
    """Stage B: episodes of adaptation, with the paper's optimiser."""

    # The meta-objective.
    method: MetaConfig = dataclasses.field(default_factory=MetaConfig)
    # Frames seen, repetitions counted.
    num_samples: Samples = 8_400_000
    # Frames a step, over all devices.
    batch_size: Batch = 32
    # Frames that a device takes at once, for memory; 0 for all of its share.
    at_once: Annotated[int, 0, 2**16] = 0
    # Points of the complete cloud that a loss looks at.
    num_complete: Points = 16_384
    # Of encoders and decoder, as in `PretrainConfig`; a final rate of 1 is constant.
    optimiser: Kind = "sgd"
    learning_rate: Rate = 5e-5
    final_rate: Share = 1.0
    warmup_steps: Samples = 0
    clip_norm: Norm = 0.0
    # Of the loss weights' logits, whose optimiser is of the same kind.
    weight_rate: Rate = 5e-4
    # Of the logarithms of learned step sizes, by Adam.
    step_rate: Rate = 1e-2
    # Of the auxiliary modules and of the refiner, if they learn.
    auxiliary_rate: Rate = 1e-3
    refiner_rate: Rate = 5e-5
    # As in `PretrainConfig`, of all variables but the scales.
    average_decay: Share = 0.0
    # Samples between validations.
    validate_every: Samples = 64_000
