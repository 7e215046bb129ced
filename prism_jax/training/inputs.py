"""A batch as what the whole network reads."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.visibility import SURFACE, UNKNOWN, Visibility, seen_by
from prism_jax.models.config import BackboneConfig, ModelConfig
from prism_jax.models.prism import NetworkInput, prepare_input
from prism_jax.preprocessing.observation import framed_view


def inputs_of(
    batch: Batch, key: Key[Array, "..."], config: ModelConfig
) -> NetworkInput:
    """A batch's inputs with a leading axis, perturbed (Eq. 6) as the key says: each by
    a key of its own, or all alike by a single one."""

    def inputs(partial, eye, visibility, key):
        camera = framed_view(partial, eye)
        return prepare_input(partial, camera, key, config, visibility)

    arrays = jnp.asarray(batch.partial), jnp.asarray(batch.eye)
    visibility = visibility_of(batch, config.backbone)
    over = jax.vmap(inputs, in_axes=(0, 0, 0, 0 if key.ndim else None))
    return over(*arrays, visibility, key)


def visibility_of(batch: Batch, config: BackboneConfig) -> Visibility | None:
    """The visibility of a batch, for a network that reads it: its maps, or else what
    its clouds say, with nothing around them. Every other row has the surface alone,
    since that is all that many users have."""
    if not config.reads_visibility:
        return None
    partial, eye = jnp.asarray(batch.partial), jnp.asarray(batch.eye)
    if batch.visibility is None:
        whole = jax.vmap(lambda cloud, eye: seen_by(cloud, eye, "empty"))(partial, eye)
    else:
        whole = jax.tree.map(jnp.asarray, batch.visibility)
    alone = (jnp.arange(len(partial)) % 2 == 1)[:, None, None]
    left_out = alone & (whole.state != SURFACE)
    return whole._replace(
        state=jnp.where(left_out, UNKNOWN, whole.state),
        depth=jnp.where(left_out, 0.0, whole.depth),
    )
