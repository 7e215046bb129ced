"""A supervised step of `small`, all stages and their losses."""

from collections.abc import Iterator

import jax
import numpy as np

from experiments.benchmarks.measure import Row, in_turn, row
from prism_jax.data.pipeline import Batch
from prism_jax.models.backbone import init_backbone, partial_indices
from prism_jax.presets import PRESETS
from prism_jax.training.pretrain import backbone_leg

SAMPLES_PER_SECOND = 100


def suite(preset: str = "small") -> Iterator[Row]:
    """Each leg of the preset's pretraining, on random clouds, the encoder's indices
    made beforehand as they are for a data set."""
    settings = PRESETS[preset]
    config, backbone = settings.pretrain, settings.model.backbone
    variables = init_backbone(jax.random.key(0), backbone)
    rng = np.random.default_rng(0)

    def cloud(*shape: int) -> np.ndarray:
        return rng.uniform(-1, 1, shape).astype(np.float32)

    size = config.batch_size
    partial, complete = (
        cloud(size, count, 3) for count in (backbone.num_points, config.num_complete)
    )
    indices = jax.jit(lambda clouds: partial_indices(clouds, backbone))(partial)
    batch = Batch(partial, complete, cloud(size, 3), cloud(size), indices)
    wanted = [1e3 * size / SAMPLES_PER_SECOND]
    for phase in config.backbone:
        leg = backbone_leg(variables, backbone, phase, config)

        def step(leg=leg):
            return jax.block_until_ready(leg.step_fn(leg.start, batch)[1])

        (times,) = in_turn(step, seconds=20.0)
        name = f"{preset}, {phase.name}, step of {size} samples"
        peer = f"{SAMPLES_PER_SECOND} samples a second"
        yield row(name, times, peer, wanted, 1.0)
