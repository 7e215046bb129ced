"""A batch as the frames that the whole network reads."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.workspace import Workspace
from prism_jax.models.config import ModelConfig
from prism_jax.models.prism import Frame, prepare_frame
from prism_jax.observation.observation import observe


def frames_of(batch: Batch, key: Key[Array, "..."], config: ModelConfig) -> Frame:
    """Frames with a leading axis, perturbed (Eq. 6) as the key says: each by a key of
    its own, or all alike by a single one."""

    def frame(partial, eye, indices, key):
        camera = observe(partial, eye, Workspace.unit()).camera
        return prepare_frame(partial, camera, key, config, indices)

    indices = jax.tree.map(lambda rows: jnp.asarray(rows, jnp.int32), batch.indices)
    over = jax.vmap(frame, in_axes=(0, 0, 0, 0 if key.ndim else None))
    return over(jnp.asarray(batch.partial), jnp.asarray(batch.eye), indices, key)
