"""Training steps of `small`: supervised, and of the meta-objective."""

from collections.abc import Callable, Iterator

import jax
import numpy as np

from experiments.benchmarks.measure import Row, in_turn, row
from prism_jax.data.pipeline import Batch
from prism_jax.models.backbone import partial_indices
from prism_jax.models.initial import init_variables
from prism_jax.presets import PRESETS, Preset
from prism_jax.training.leg import Leg
from prism_jax.training.meta import meta_leg
from prism_jax.training.pretrain import backbone_leg

SAMPLES_PER_SECOND = 100
MOST = 4.0
"""Times a supervised step, for a meta-step with one inner step."""


def suite(preset: str = "small") -> Iterator[Row]:
    """Each leg of the preset's pretraining, and a meta-step beside the last of them.

    On random clouds, the encoder's indices made beforehand as they are for a data set.
    """
    settings = PRESETS[preset]
    config, backbone = settings.pretrain, settings.model.backbone
    variables = init_variables(jax.random.key(0), settings.model)
    kinds = ("params", "batch_stats")
    own = {
        kind: {name: variables[kind][name] for name in ("point_encoder", "decoder")}
        for kind in kinds
    }
    batch, step = _batch(settings), None
    wanted = [1e3 * config.batch_size / SAMPLES_PER_SECOND]
    for phase in config.backbone:
        step = _step(backbone_leg(own, backbone, phase, config), batch)
        (times,) = in_turn(step, seconds=20.0)
        name = f"{preset}, {phase.name}, step of {config.batch_size} samples"
        yield row(name, times, f"{SAMPLES_PER_SECOND} samples a second", wanted, 1.0)
    assert step is not None
    meta = _step(meta_leg(variables, settings.adapt, settings.meta, 0), batch)
    ours, theirs = in_turn(meta, step, seconds=30.0)
    name = f"{preset}, meta-step of {settings.meta.batch_size} samples"
    yield row(name, ours, f"{config.backbone[-1].name}, step", theirs, MOST)


def _step(leg: Leg, batch: Batch) -> Callable[[], object]:
    return lambda: jax.block_until_ready(leg.step_fn(leg.start, batch)[1])


def _batch(settings: Preset) -> Batch:
    rng = np.random.default_rng(0)

    def cloud(*shape: int) -> np.ndarray:
        return rng.uniform(-1, 1, shape).astype(np.float32)

    config, backbone = settings.pretrain, settings.model.backbone
    size = config.batch_size
    partial, complete = (
        cloud(size, count, 3) for count in (backbone.num_points, config.num_complete)
    )
    indices = jax.jit(lambda clouds: partial_indices(clouds, backbone))(partial)
    eye = np.tile(np.float32([2.0, -2.0, 1.0]), (size, 1))
    return Batch(partial, complete, eye, np.ones(size, np.float32), indices)
