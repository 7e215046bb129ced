"""Stand-ins for the networks in meta-training, which compile in no time.

The gradient of every parameter is one number, that of the batch; a completion is the
partial, moved.
"""

import jax
import jax.numpy as jnp

from prism_jax.adaptation.meta import MetaTerms, learned_part
from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.test_time import Completion
from prism_jax.models.prism import NetworkInput
from prism_jax.training import inputs as training_inputs
from prism_jax.training import meta


def prepare_input(partial, camera, key, config, visibility=None):
    """Its perturbation is the noise alone."""
    frame = NetworkInput(*[partial.mean()] * len(NetworkInput._fields))
    noise = jax.random.normal(key, partial.shape)
    return frame._replace(partial=partial, perturbed=noise)


def slopes(partials, complete):
    """Of each frame, a number around one."""
    near = (partials**2).sum(-1).mean(-1)
    return 1.0 + near - (complete**2).sum(-1).mean(-1)


def meta_gradients(variables, frames, complete, adapt, config):
    """The losses tell of the frames what else is to be known: `denoise`, their noise;
    `align`, how far it is not the same."""
    slope = slopes(frames.partial, complete).mean()
    learned = learned_part(variables, config)
    grads = jax.tree.map(lambda leaf: jnp.full_like(leaf, slope), learned)
    noise = frames.perturbed
    losses = Losses(
        3.0 + slope,
        4.0 + slope,
        jnp.float32(0.0),
        jnp.abs(noise).mean(),
        jnp.abs(noise - noise[0]).max(),
    )
    return grads, MetaTerms(1.0 + slope, 2.0 + slope, losses, 8.0 + slope)


def make_adapt(config):
    """Moves the partial towards the camera, if that stands above it; the farther, the
    more is measured in the map."""

    def adapt(variables, partial, camera, visibility=None):
        accepted = camera.position[2] > 0
        measured = 0.0 if visibility is None else (visibility.state > 0).mean()
        towards = (0.05 + measured) * camera.position
        points = jnp.where(accepted, partial + towards, partial)
        return Completion(points, partial, accepted, None, None, {}, None)

    return adapt


def replace_networks(patch):
    """What the phase knows of the networks is this module's."""
    patch.setattr(training_inputs, "prepare_input", prepare_input)
    for stand_in in (meta_gradients, make_adapt):
        patch.setattr(meta, stand_in.__name__, stand_in)
