"""Memory of a meta-step of `paper`, as the compiler plans it; nothing is run."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure import MIB, Row, row
from prism_jax.data.pipeline import Batch
from prism_jax.models.initial import init_variables
from prism_jax.presets import PRESETS
from prism_jax.training.meta import meta_leg

GPU_MIB = 80e9 / MIB


def suite(preset: str = "paper") -> Iterator[Row]:
    """A whole batch on one device, beside an accelerator of 80 GB."""
    settings = PRESETS[preset]
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), settings.model))
    variables = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    config = settings.meta
    leg = meta_leg(variables, settings.adapt, config, 0)

    def floats(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((config.batch_size, *shape), jnp.float32)

    partial = floats(settings.model.backbone.num_points, 3)
    complete = floats(config.num_complete, 3)
    batch = Batch(partial, complete, floats(3), floats())  # pyright: ignore
    compiled = jax.jit(leg.step_fn).lower(leg.start, batch).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    bytes_ = analysis.temp_size_in_bytes + analysis.argument_size_in_bytes
    name = f"{preset}, meta-step of {config.batch_size}, {config.at_once} at once"
    yield row(name, [bytes_ / MIB], "80 GB", [GPU_MIB], 1.0, unit="MiB")
