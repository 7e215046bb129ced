"""Test-time adaptation against a plain completion of the same weights."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure import Compiled, Row, in_turn, row
from experiments.presets import PRESETS
from experiments.weights import located
from prism_jax import Camera, Workspace, load_pretrained, make_adapt, observe
from prism_jax.completion.weights import available_weights
from prism_jax.geometry.sampling import resample
from prism_jax.models.initial import init_variables

FRAMES_PER_SECOND = 10
STEPS = 3
"""Of adaptation, the paper's K at test time."""
MOST = 7.0
"""Times a plain completion, for four forward passes and three backward ones."""


def suite(weights: str = "small") -> Iterator[Row]:
    """One frame at a time, and eight at once; memory as the steps grow.

    A preset without weights is timed as it is before training.
    """
    if weights in PRESETS and weights not in available_weights():
        config = PRESETS[weights].config
        variables = init_variables(jax.random.key(0), config.model)
    else:
        config, variables = load_pretrained(located(weights))

    def compiled(num_steps: int, batch: int) -> Compiled:
        adapt = make_adapt(config.with_adapt(num_steps=num_steps))
        frames = _frames(batch, config.model.backbone.num_points)
        return Compiled(jax.vmap(adapt, (None, 0, 0)), variables, *frames)

    peaks = []
    for batch in (1, 8):
        ours = compiled(STEPS, batch)
        peaks.append(ours.peak_mib or np.nan)
        times = in_turn(ours, compiled(0, batch), seconds=10.0)
        name = f"{weights}, K = {STEPS}, {batch} at once"
        yield row(name, times[0], "K = 0", times[1], MOST, **ours.costs)
        wanted = [1e3 * batch / FRAMES_PER_SECOND]
        peer_name = f"{FRAMES_PER_SECOND} frames a second"
        yield row(name, times[0], peer_name, wanted, 1.0, **ours.costs)
    longer = [compiled(3 * STEPS, 1).peak_mib or np.nan]
    name = f"{weights}, memory of K = {3 * STEPS}"
    yield row(name, longer, f"K = {STEPS}", peaks[:1], 1.05, unit="MiB")


def _frames(batch: int, num_points: int) -> tuple[jax.Array, Camera]:
    """Half of an ellipsoid, as seen from one side, with another noise in each frame."""
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(batch, 4 * num_points, 3))
    shell /= np.linalg.norm(shell, axis=-1, keepdims=True)
    shell[..., 0] = -np.abs(shell[..., 0])
    points = jnp.asarray(shell * [0.6, 0.4, 0.3], jnp.float32)
    partials = jax.vmap(lambda cloud: resample(cloud, num_points))(points)
    eye = jnp.asarray([-3.0, 0.0, 0.5])
    unit = Workspace.unit()
    return partials, jax.vmap(lambda cloud: observe(cloud, eye, unit).camera)(partials)
