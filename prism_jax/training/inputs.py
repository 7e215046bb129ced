"""A batch as what the whole network reads."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.visibility import Visibility, seen_by, surface_alone
from prism_jax.models.config import ModelConfig
from prism_jax.models.prism import NetworkInput, prepare_input
from prism_jax.preprocessing.observation import framed_view


def inputs_of(
    batch: Batch, key: Key[Array, "..."], config: ModelConfig
) -> NetworkInput:
    """A batch's inputs with a leading axis, perturbed (Eq. 6) as the key says: each by
    a key of its own, or all alike by a single one."""

    def inputs(partial, eye, indices, known, key):
        camera = framed_view(partial, eye)
        return prepare_input(partial, camera, key, config, indices, known)

    indices = jax.tree.map(lambda rows: jnp.asarray(rows, jnp.int32), batch.indices)
    arrays = jnp.asarray(batch.partial), jnp.asarray(batch.eye), indices
    known = visibility_of(batch) if config.backbone.reads_visibility else None
    over = jax.vmap(inputs, in_axes=(0, 0, 0, 0, 0 if key.ndim else None))
    return over(*arrays, known, key)


def visibility_of(batch: Batch) -> Visibility:
    """What the sensors of a batch know, in every other row of the surface alone.

    Of a batch without maps what its clouds say, which have nothing around them. In the
    other rows a network learns to do with the cloud alone, which is all that many users
    have.
    """
    partial, eye = jnp.asarray(batch.partial), jnp.asarray(batch.eye)
    if batch.visibility is None:
        known = jax.vmap(lambda cloud, eye: seen_by(cloud, eye, "empty"))(partial, eye)
    else:
        known = jax.tree.map(jnp.asarray, batch.visibility)
    alone = (jnp.arange(len(partial)) % 2 == 1)[:, None, None]
    less = surface_alone(known)
    return known._replace(
        state=jnp.where(alone, less.state, known.state),
        depth=jnp.where(alone, less.depth, known.depth),
    )
