"""Training of a network to compare with, as our own backbone is trained."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from prism_jax.data.pipeline import Batch
from prism_jax.models.variables import Variables, apply, apply_training
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.phase import Phase
from prism_jax.training.supervised import Stages, supervised_phase


def network_phase(
    module: nn.Module,
    num_points: int,
    phase: PhaseConfig,
    training: PretrainConfig,
    seed: int,
) -> Phase:
    """A network from ``(B, num_points, 3)`` to its stages, from fresh variables on."""
    key = jax.random.key(seed)

    def init(key: Array) -> Variables:
        first, second = jax.random.split(key)
        cloud = jax.random.uniform(first, (1, num_points, 3), minval=-1.0)
        made = module.init(second, cloud)
        return {kind: made.get(kind, {}) for kind in ("params", "batch_stats")}

    def train(variables: Variables, batch: Batch):
        partial = jnp.asarray(batch.partial)
        return apply_training(module, variables, partial)

    def stages(variables: Variables, batch: Batch) -> Stages:
        return apply(module, variables, jnp.asarray(batch.partial))

    variables = jax.jit(init)(key)
    cloud = jax.ShapeDtypeStruct((1, num_points, 3), jnp.float32)
    made = jax.eval_shape(lambda cloud: apply(module, variables, cloud), cloud)
    names = tuple(f"stage_{i}" for i in range(len(made)))
    return supervised_phase(variables, train, stages, names, phase, training)
