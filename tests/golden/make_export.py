"""Writes export.npz: what the oldest supported JAX exported, and its completion.

python -m tests.golden.make_export
"""

import pathlib

import jax
import numpy as np

from experiments.export import export_adapt
from experiments.settings import resolve
from prism_jax.models.initial import init_variables

PATH = pathlib.Path(__file__).parent / "export.npz"
CHANGES = (
    *("num_neighbors=(4,)", "encoder_rates=(1,)"),
    *("level_rates=((1,),)", "up_factors=(2,)"),
)

if __name__ == "__main__":
    preset = resolve("tiny", [f"model.backbone.{change}" for change in CHANGES])
    config = preset.config.with_adapt(num_steps=0)
    variables = init_variables(jax.random.key(0), config.model)
    written = export_adapt(config, variables, platforms=["cpu"])
    shape = 1, config.model.backbone.num_points, 3
    scan = np.random.default_rng(0).uniform([4, -1, -1], [5, 1, 1], shape)
    given = scan.astype(np.float32), np.zeros((1, 3), np.float32)
    points = jax.export.deserialize(bytearray(written)).call(*given)["points"]
    function = np.frombuffer(written, np.uint8)
    arrays = {"function": function, "scan": given[0], "points": points}
    np.savez_compressed(PATH, version=jax.__version__, **arrays)
