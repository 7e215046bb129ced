"""Completion as one file that needs nothing but JAX and flatbuffers to run."""

from collections.abc import Sequence

import jax
import jax.export
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.models.variables import Variables
from prism_jax.preprocessing.observation import observe

PLATFORMS = ("cpu", "cuda")


def export_adapt(
    config: PrismConfig,
    variables: Variables,
    batch_size: int = 1,
    platforms: Sequence[str] = PLATFORMS,
) -> bytes:
    """Completion, after `config.adapt.num_steps` of adaptation, weights included, as
    portable StableHLO (`jax.export`).

    `jax.export.deserialize` gives it back: its ``call`` takes scans ``(B, N, 3)`` of
    exactly ``config.model.backbone.num_points`` points, and the sensors' positions
    ``(B, 3)``, not finite where unknown, float32, in any unit of length and any upright
    frame (z up), and returns

    - ``points`` ``(B, M, 3)``, the network's completion in that unit and frame;
    - ``accepted`` ``(B,)``, whether the adapted completion is the one returned;
    - ``objective`` ``(B, K + 1)``, L_TTA of Eq. 13 before each step and after the last,
      if there are steps;
    - ``left_out`` ``(B,)``, how many points lay so far from all others that copies of
      another took their places.

    The workspace is taken from each scan. Precision is float32's: move a scan that is
    far from its frame's origin there first.
    """
    adapt = make_adapt(config)

    def complete(scan: Float[Array, "N 3"], sensor: Float[Array, "3"]):
        seen = observe(scan, sensor, config.model).filled()
        completion = adapt(variables, jnp.asarray(seen.partial), seen.camera)
        steps = completion.losses
        return {
            "points": seen.workspace.from_unit(completion.points),
            "accepted": completion.accepted,
            "left_out": jnp.sum(~seen.inside),
            **({} if steps is None else {"objective": steps.objective}),
        }

    num_points = config.model.backbone.num_points
    scans = jax.ShapeDtypeStruct((batch_size, num_points, 3), jnp.float32)
    sensors = jax.ShapeDtypeStruct((batch_size, 3), jnp.float32)
    export = jax.export.export(jax.jit(jax.vmap(complete)), platforms=platforms)
    return bytes(export(scans, sensors).serialize())
