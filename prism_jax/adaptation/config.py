"""Settings of test-time adaptation and of the meta-objective."""

import dataclasses
from typing import Any, Literal

from prism_jax.losses.chamfer import ChamferNorm
from prism_jax.losses.weighting import BRANCHES, Branch
from prism_jax.models.config import ModelConfig
from prism_jax.models.ranges import check_ranges

WeightRule = Literal["auxiliary", "meta"]
Moves = Literal["encoders", "global"]


@dataclasses.dataclass(frozen=True)
class AdaptConfig:
    """Eq. 13 with the paper's values where it gives them.

    Attributes:
      num_steps: gradient steps per frame, K_TTA.
      step_size: of plain SGD, alpha_TTA; learned steps are multiples of it. A
        negative one goes uphill.
      clip_norm: bound on the global norm of the gradient of a step; 0 for none. One
        frame's can be ten times another's.
      depth_weight: of the depth consistency; 1 as in Eq. 13.
      auxiliary_weight: of the weighted losses of Eq. 11; 1 as in Eq. 13.
      visibility_weight: of what the completion has where the sensor saw emptiness
        (`prism_jax.losses.visibility`); not in the paper.
      keep_weight: of what the unadapted completion had right and the adapted one leaves
        uncovered; not in the paper.
      learned_weight: of the mean error that the learned term expects of the predicted
        points (`prism_jax.models.error_head`), with weights that have one; not in the
        paper.
      balance: whether every term of Eq. 13 is divided by the norm of its gradient in
        the encoders before the first step, in the place of its scale from training: the
        weights then say how far each moves them, whatever its unit. What is kept has
        the norm of what is seen, since its own is zero there.
      lambda_smooth: of the normals' smoothness in Eq. 5.
      normal_neighbors: neighbourhood of the PCA normals.
      normal_stride: Eq. 5 is the mean over every so many-th point. The children of a
        point follow one another, so with 4 and eight children (`small`) the mean is
        over the same two children of every point.
      lambda_offset: of the denoiser's offsets in Eq. 6.
      lambda_sigma: of the covariances in Eq. 7.
      lambda_transport: of the optimal transport in Eq. 9.
      transport_epsilon: entropy of Eq. 8, as a share of the mean cost.
      adapt_norm: whether BatchNorm's scales and biases adapt with the encoders; its
        statistics never do (gap 17).
      seed: of the perturbation A of Eq. 6.
    """

    num_steps: int = 3
    step_size: float = 1e-3
    clip_norm: float = 0.0
    depth_weight: float = 1.0
    auxiliary_weight: float = 1.0
    visibility_weight: float = 0.0
    keep_weight: float = 0.0
    learned_weight: float = 0.0
    balance: bool = False
    lambda_smooth: float = 0.1
    normal_neighbors: int = 16
    normal_stride: int = 1
    lambda_offset: float = 0.1
    lambda_sigma: float = 1.0
    lambda_transport: float = 1.0
    transport_epsilon: float = 0.05
    adapt_norm: bool = True
    seed: int = 0

    def __post_init__(self):
        weight = (0, 1e6)
        check_ranges(
            self,
            num_steps=(0, 10_000),
            step_size=(-1e6, 1e6),
            clip_norm=weight,
            depth_weight=weight,
            auxiliary_weight=weight,
            visibility_weight=weight,
            keep_weight=weight,
            learned_weight=weight,
            lambda_smooth=weight,
            normal_neighbors=(2, 64),
            normal_stride=(1, 2**16),
            lambda_offset=weight,
            lambda_sigma=weight,
            lambda_transport=weight,
            transport_epsilon=(1e-6, 1e6),
            seed=(0, 2**32 - 1),
        )


@dataclasses.dataclass(frozen=True)
class PrismConfig:
    """What weights are used with: the networks, and how they adapt to a frame."""

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    adapt: AdaptConfig = dataclasses.field(default_factory=AdaptConfig)

    def with_adapt(self, **changes: Any) -> "PrismConfig":
        """The same networks with other settings of adaptation."""
        adapt = dataclasses.replace(self.adapt, **changes)
        return dataclasses.replace(self, adapt=adapt)

    def with_model(self, **changes: Any) -> "PrismConfig":
        """The same with other fields of the model, such as its poses."""
        model = dataclasses.replace(self.model, **changes)
        return dataclasses.replace(self, model=model)


@dataclasses.dataclass(frozen=True)
class MetaConfig:
    """Eq. 11 and 12, with the paper's values where it gives them.

    Attributes:
      num_steps: of the inner loop, K; its step size is `AdaptConfig.step_size`.
      first_order: whether the inner gradients count as constants.
      beta_0: weight of the zero-step term.
      lambda_aux: of what the inner loop descends, which the encoders also descend. At
        0, as in `small`, the outer loop has no auxiliary loss of its own.
      weight_rule: what teaches the logits of the loss weights: "auxiliary", the
        weighted loss itself, as in the paper, or "meta" (`small`), the primary loss
        after adaptation: a weight grows if that makes the adapted completion better.
      branches: the losses of Eq. 11 that count; the others get no weight, in training
        and ever after.
      rehearse_depth: whether the inner loop descends the depth consistency too, and
        whatever else of one completion test time descends, and so exactly what test
        time does (Eq. 13 in the place of Eq. 11).
      learn_steps: whether a step size is learned for each module of the encoders
        (Meta-SGD, Li et al., 2017).
      moves: what the steps move, in training and ever after: both encoders, or of the
        point encoder the module that makes the global feature alone.
      learn_backbone: whether encoders and decoder learn. If not they stay, and what is
        learned is how to adapt them: to be had from data that they have not seen.
      learn_term: whether the learned term learns, from the primary loss after
        adaptation; the variables must have one.
      learn_auxiliary: whether the auxiliary modules learn too, from the primary loss
        after adaptation: what the inner loop descends is then itself learned (Bechtle
        et al., Meta-learning via learned loss, 2019). In the paper they are frozen.
      learn_refiner: whether the refiner learns, from Eq. 3; if not, it stays.
      remat: whether the backward pass computes the networks anew, for memory.
      norm: Chamfer convention of Eq. 10. Presets train on CD-L1; scores, and what is
        said of them, are in CD-L2.
    """

    num_steps: int = 1
    first_order: bool = False
    beta_0: float = 0.1
    lambda_aux: float = 10.0
    weight_rule: WeightRule = "auxiliary"
    branches: tuple[Branch, ...] = BRANCHES
    rehearse_depth: bool = False
    learn_steps: bool = False
    moves: Moves = "encoders"
    learn_backbone: bool = True
    learn_term: bool = False
    learn_auxiliary: bool = False
    learn_refiner: bool = True
    remat: bool = False
    norm: ChamferNorm = "l1"

    def __post_init__(self):
        check_ranges(self, num_steps=(0, 100), beta_0=(0, 1), lambda_aux=(0, 1e6))
