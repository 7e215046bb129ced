"""Memory of a preset's steps, as the compiler plans it; nothing is run."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure import MIB, Row, row
from experiments.settings import resolve
from prism_jax.data.pipeline import Batch
from prism_jax.models.initial import init_variables
from prism_jax.training.auxiliary import auxiliary_phase
from prism_jax.training.meta import meta_phase
from prism_jax.training.phase import Phase
from prism_jax.training.supervised import backbone_phase

GPU_MIB = 80e9 / MIB


def suite(preset: str = "paper") -> Iterator[Row]:
    """A whole batch of every phase on one device, beside an accelerator of 80 GB."""
    settings = resolve(preset)
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), settings.model))
    variables = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    backbone = settings.model.backbone
    phases = [
        *(
            backbone_phase(variables, settings.model.backbone, each, settings.pretrain)
            for each in settings.pretrain.backbone
        ),
        auxiliary_phase(variables, settings.config, settings.pretrain, 0),
        meta_phase(variables, settings.config, settings.meta, 0),
    ]
    for phase in phases:
        name = f"{preset}, {phase.name}, step of {phase.batch_size}"
        ours = [_planned(phase, backbone.num_points) / MIB]
        yield row(name, ours, "80 GB", [GPU_MIB], 1.0, unit="MiB")


def _planned(phase: Phase, num_points: int) -> int:
    """Bytes of a step's temporaries and arguments."""

    def floats(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((phase.batch_size, *shape), jnp.float32)

    clouds = floats(num_points, 3), floats(phase.num_complete, 3)
    batch = Batch(*clouds, floats(3), floats())  # pyright: ignore
    compiled = jax.jit(phase.step_fn).lower(phase.start, batch).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes + analysis.argument_size_in_bytes
