"""Writes the sample scan of the package, and its complete shape for comparison.

python -m experiments.make_sample --category=car --index=50
"""

import pathlib

import numpy as np
from absl import flags

from experiments.simulation.partials import HALF_EXTENT
from experiments.simulation.shapes import CATEGORIES
from experiments.simulation.shapes.build import ShapesConfig, shape_seed
from experiments.simulation.views import make_views
from prism_jax.cli.launch import launch
from prism_jax.io.atomic import write_bytes
from prism_jax.io.ply import ply_bytes

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum("category", "car", CATEGORIES, "What is scanned.")
    flags.DEFINE_integer("index", 50, "Which of the validation split's seeds.")
    flags.DEFINE_string("output_dir", "prism_jax/assets", "Where the files go.")


def main():
    """One example in metres, seen by a sensor at the origin, z up."""
    seed = shape_seed(ShapesConfig("validation"), FLAGS.index)
    (partial,), complete, (viewpoint,), *_ = make_views(FLAGS.category, seed)
    folder = pathlib.Path(FLAGS.output_dir)
    for name, cloud in {"sample": partial, "sample_complete": complete}.items():
        points = (cloud - viewpoint) * np.float32(HALF_EXTENT)
        cloud = ply_bytes(points, np.zeros(len(points), bool))
        write_bytes(folder / f"{name}.ply", cloud)


def run():
    """The entry point."""
    define_flags()
    launch("make_sample", main)


if __name__ == "__main__":
    run()
