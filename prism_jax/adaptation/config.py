"""Settings of test-time adaptation and of the meta-objective."""

import dataclasses
from typing import Annotated, Any, Literal

from prism_jax.losses.chamfer import ChamferNorm
from prism_jax.losses.weighting import BRANCHES, Branch
from prism_jax.models.config import ModelConfig
from prism_jax.models.ranges import Checked

WeightRule = Literal["auxiliary", "meta"]
Weight = Annotated[float, 0, 1e6]


@dataclasses.dataclass(frozen=True)
class AdaptConfig(Checked):
    """Eq. 13 with the paper's values where it gives them."""

    # Gradient steps per frame, K_TTA.
    num_steps: Annotated[int, 0, 10_000] = 3
    # Of plain SGD, alpha_TTA; learned steps are multiples of it. Negative ones ascend.
    step_size: Annotated[float, -1e6, 1e6] = 1e-3
    # Bound on the global norm of a step's gradient; 0 for none.
    clip_norm: Weight = 0.0
    # Of the depth consistency, and of the weighted losses of Eq. 11.
    depth_weight: Weight = 1.0
    auxiliary_weight: Weight = 1.0
    # Of the normals' smoothness in Eq. 5.
    lambda_smooth: Weight = 0.1
    # Neighbourhood of the PCA normals.
    normal_neighbors: Annotated[int, 2, 64] = 16
    # Eq. 5 is the mean over every so many-th point.
    normal_stride: Annotated[int, 1, 2**16] = 1
    # Of the denoiser's offsets in Eq. 6.
    lambda_offset: Weight = 0.1
    # Of the covariances in Eq. 7.
    lambda_sigma: Weight = 1.0
    # Of the optimal transport in Eq. 9.
    lambda_transport: Weight = 1.0
    # Entropy of Eq. 8, as a share of the mean cost.
    transport_epsilon: Annotated[float, 1e-6, 1e6] = 0.05
    # Whether BatchNorm's scales and biases adapt; its statistics never do (gap 17).
    adapt_norm: bool = True
    # Of the perturbation A of Eq. 6.
    seed: Annotated[int, 0, 2**32 - 1] = 0


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
class MetaConfig(Checked):
    """Eq. 11 and 12, with the paper's values where it gives them."""

    # Of the inner loop, K; its step size is `AdaptConfig.step_size`.
    num_steps: Annotated[int, 0, 100] = 1
    # Whether the inner gradients count as constants.
    first_order: bool = False
    # Weight of the zero-step term.
    beta_0: Annotated[float, 0, 1] = 0.1
    # Of what the inner loop descends, which the encoders also descend.
    lambda_aux: Weight = 10.0
    # What teaches the logits of the loss weights: the weighted loss itself, as in the
    # paper, or ("meta") the primary loss after adaptation.
    weight_rule: WeightRule = "auxiliary"
    # The losses of Eq. 11 that count; others get no weight, in training and ever after.
    branches: tuple[Branch, ...] = BRANCHES
    # Whether the inner loop descends Eq. 13, as test time does, and not Eq. 11.
    rehearse_depth: bool = False
    # Whether each encoder module learns its step size (Meta-SGD, Li et al., 2017).
    learn_steps: bool = False
    # Whether the auxiliary modules learn too (Bechtle et al., Meta-learning via learned
    # loss, 2019). The paper freezes them.
    learn_auxiliary: bool = False
    # Whether the refiner learns, from Eq. 3.
    learn_refiner: bool = True
    # Whether the backward pass computes the networks anew, for memory.
    remat: bool = False
    # Chamfer convention of Eq. 10. Presets train on CD-L1; scores are in CD-L2.
    norm: ChamferNorm = "l1"
