"""A batch as what the whole network reads."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.workspace import Workspace
from prism_jax.models.config import ModelConfig
from prism_jax.models.prism import NetworkInput, prepare_input
from prism_jax.observation.observation import observe


def inputs_of(
    batch: Batch, key: Key[Array, "..."], config: ModelConfig
) -> NetworkInput:
    """A batch's inputs with a leading axis, perturbed (Eq. 6) as the key says: each by
    a key of its own, or all alike by a single one."""

    def inputs(partial, eye, indices, key):
        camera = observe(partial, eye, Workspace.unit()).camera
        return prepare_input(partial, camera, key, config, indices)

    indices = jax.tree.map(lambda rows: jnp.asarray(rows, jnp.int32), batch.indices)
    over = jax.vmap(inputs, in_axes=(0, 0, 0, 0 if key.ndim else None))
    return over(jnp.asarray(batch.partial), jnp.asarray(batch.eye), indices, key)
