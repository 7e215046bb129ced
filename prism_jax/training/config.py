"""What a training does, in frozen dataclasses."""

import dataclasses

from prism_jax.losses.chamfer import ChamferNorm


@dataclasses.dataclass(frozen=True)
class PhaseConfig:
    """One leg of a pretraining.

    Attributes:
      name: what the log and the checkpoints call it.
      num_samples: examples seen, repetitions counted.
      num_blocks: up-sampling blocks trained: 0 for encoder and seeds alone, None for
        all.
      learning_rate: Adam's step size after the warm-up; it falls along a cosine.
      final_rate: where the cosine ends, as a share of learning_rate.
    """

    name: str
    num_samples: int
    num_blocks: int | None
    learning_rate: float = 1e-3
    final_rate: float = 0.01


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """Stage A: what makes weights for meta-training to start from (gap 4).

    Attributes:
      backbone: legs on Eq. 10, coarse stages first.
      auxiliary_samples: examples for the refiner (Eq. 3), the depth encoder and the
        auxiliary heads, on the finished backbone.
      auxiliary_rate: Adam's step size for those.
      batch_size: examples a step.
      num_complete: points of the complete cloud that a loss looks at.
      norm: Chamfer convention of Eq. 10 in training.
      warmup_steps: steps in which the step size rises from zero.
      clip_norm: bound on the gradient's global norm.
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
    validate_every: int = 16_000
