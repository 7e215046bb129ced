"""Test-time adaptation against a plain completion of the same weights."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure import Compiled, Row, in_turn, row
from prism_jax import Camera, load_pretrained, make_adapt
from prism_jax.geometry import resample

FRAMES_PER_SECOND = 10
FLOOR = 7.0
"""Times a plain completion; four forward and three backward passes are the least."""


def suite(weights: str = "small") -> Iterator[Row]:
    """One frame at a time, and eight at once."""
    config, variables = load_pretrained(weights)
    plain = dataclasses.replace(config, num_steps=0)
    for batch in (1, 8):
        partials, cameras = _frames(batch, config.model.backbone.num_points)
        arguments = (variables, partials, cameras)
        steps = config.num_steps
        ours = Compiled(jax.vmap(make_adapt(config), (None, 0, 0)), *arguments)
        peer = Compiled(jax.vmap(make_adapt(plain), (None, 0, 0)), *arguments)
        times = in_turn(ours, peer, seconds=10.0)
        name = f"{weights}, K = {steps}, {batch} at once"
        yield row(name, times[0], "K = 0", times[1], FLOOR, **ours.costs)
        wanted = [1e3 * batch / FRAMES_PER_SECOND]
        peer_name = f"{FRAMES_PER_SECOND} frames a second"
        yield row(name, times[0], peer_name, wanted, 1.0, **ours.costs)
    longer = dataclasses.replace(config, num_steps=3 * config.num_steps)
    partials, cameras = _frames(1, config.model.backbone.num_points)
    compiled = [
        Compiled(jax.vmap(make_adapt(c), (None, 0, 0)), variables, partials, cameras)
        for c in (longer, config)
    ]
    peaks = [[c.peak_mib or np.nan] for c in compiled]
    name = f"{weights}, memory of K = {longer.num_steps}"
    peer_name = f"K = {config.num_steps}"
    yield row(name, peaks[0], peer_name, peaks[1], 1.05, unit="MiB")


def _frames(batch: int, num_points: int) -> tuple[jax.Array, Camera]:
    """Half of an ellipsoid, as seen from one side, with another noise in each frame."""
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(batch, 4 * num_points, 3))
    shell /= np.linalg.norm(shell, axis=-1, keepdims=True)
    shell[..., 0] = -np.abs(shell[..., 0])
    points = jnp.asarray(shell * [0.6, 0.4, 0.3], jnp.float32)
    partials = jax.vmap(lambda cloud: resample(cloud, num_points))(points)
    eye = jnp.asarray([-3.0, 0.0, 0.5])
    return partials, jax.vmap(lambda cloud: Camera.framing(cloud, eye))(partials)
