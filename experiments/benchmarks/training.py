"""Training steps of a preset: supervised, and of the meta-objective."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure import Compiled, Row, in_turn, row
from experiments.presets import Preset
from experiments.settings import resolve
from prism_jax.data.pipeline import Batch
from prism_jax.models.backbone import init_backbone
from prism_jax.models.initial import init_variables
from prism_jax.training.meta import meta_phase
from prism_jax.training.phase import Phase
from prism_jax.training.supervised import backbone_phase

SAMPLES_PER_SECOND = 100
MOST = 4.0
"""Times a supervised step, for a meta-step with one inner step."""
SIDE = 4096
"""Of the matrices whose product tells what arithmetic this machine does at best."""


def suite(preset: str = "small") -> Iterator[Row]:
    """Each phase of the preset's pretraining, and a meta-step beside the last of them.

    On random clouds. A supervised step stands also beside the time in which a matrix
    product has as many operations; of the meta-step, which is a loop, the compiler does
    not know how many.
    The last step stands beside that of a network which is not told what the sensor
    knows, if its own is.
    """
    settings = resolve(preset)
    config = settings.pretrain
    variables = init_variables(jax.random.key(0), settings.model)
    kinds = ("params", "batch_stats")
    parts = ("point_encoder", "decoder")
    own = {kind: {name: variables[kind][name] for name in parts} for kind in kinds}
    batch, step = _batch(settings), None
    product = Compiled(jnp.matmul, *(np.ones((2, SIDE, SIDE), np.float32)))
    (products,) = in_turn(product, seconds=5.0)
    best = np.median(products) / product.flops
    wanted = [1e3 * config.batch_size / SAMPLES_PER_SECOND]
    for phase in config.backbone:
        step = _step(backbone_phase(own, settings.model.backbone, phase, config), batch)
        (times,) = in_turn(step, seconds=20.0)
        name = f"{preset}, {phase.name}, step of {config.batch_size} samples"
        peer = f"{SAMPLES_PER_SECOND} samples a second"
        yield row(name, times, peer, wanted, 1.0, **step.costs)
        yield row(name, times, "its operations, as a product", [best * step.flops])
    assert step is not None
    backbone = settings.model.backbone
    if backbone.reads_visibility:
        backbone = dataclasses.replace(
            backbone, reads_visibility=False, seeds_read_visibility=False
        )
        fresh = init_backbone(jax.random.key(0), backbone)
        phase = config.backbone[-1]
        blind = _step(backbone_phase(fresh, backbone, phase, config), batch)
        ours, theirs = in_turn(step, blind, seconds=30.0)
        name = f"{preset}, {phase.name}, step of {config.batch_size} samples"
        yield row(name, ours, "the same, not told what the sensor knows", theirs)
    meta = _step(meta_phase(variables, settings.config, settings.meta, 0), batch)
    ours, theirs = in_turn(meta, step, seconds=30.0)
    name = f"{preset}, meta-step of {settings.meta.batch_size} samples"
    yield row(
        name, ours, f"{config.backbone[-1].name}, step", theirs, MOST, **meta.costs
    )


def _step(phase: Phase, batch: Batch) -> Compiled:
    return Compiled(phase.step_fn, phase.start, batch)


def _batch(settings: Preset) -> Batch:
    rng = np.random.default_rng(0)

    def cloud(*shape: int) -> np.ndarray:
        return rng.uniform(-1, 1, shape).astype(np.float32)

    config, backbone = settings.pretrain, settings.model.backbone
    size = config.batch_size
    partial, complete = (
        cloud(size, count, 3) for count in (backbone.num_points, config.num_complete)
    )
    eye = np.tile(np.array([2.0, -2.0, 1.0], np.float32), (size, 1))
    return Batch(partial, complete, eye, np.ones(size, np.float32))
