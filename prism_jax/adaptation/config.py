"""Settings of test-time adaptation."""

import dataclasses

from prism_jax.models.config import ModelConfig


@dataclasses.dataclass(frozen=True)
class AdaptConfig:
    """Eq. 13 with the paper's values where it gives them.

    Attributes:
      model: the networks.
      num_steps: gradient steps per frame, K_TTA.
      step_size: of plain SGD, alpha_TTA.
      depth_weight: of the depth consistency; 1 as in Eq. 13.
      lambda_smooth: of the normals' smoothness in Eq. 5.
      normal_neighbors: neighbourhood of the PCA normals.
      lambda_offset: of the denoiser's offsets in Eq. 6.
      lambda_sigma: of the covariances in Eq. 7.
      lambda_transport: of the optimal transport in Eq. 9.
      transport_epsilon: entropy of Eq. 8, as a share of the mean cost.
      adapt_norm: whether BatchNorm's scales and biases adapt with the encoders; its
        statistics never do (gap 17).
      seed: of the perturbation A of Eq. 6.
    """

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    num_steps: int = 3
    step_size: float = 1e-3
    depth_weight: float = 1.0
    lambda_smooth: float = 0.1
    normal_neighbors: int = 16
    lambda_offset: float = 0.1
    lambda_sigma: float = 1.0
    lambda_transport: float = 1.0
    transport_epsilon: float = 0.05
    adapt_norm: bool = True
    seed: int = 0
