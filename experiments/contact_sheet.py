"""Draws a picture of the procedural shapes, of views of them, or of the robot cells.

python -m experiments.contact_sheet --output=docs/shapes.png
python -m experiments.contact_sheet --dataset=roboarm --output=cells.png
python -m experiments.contact_sheet --dataset=views --output=docs/views.png \
    --category=chair --category=gearbox --category=conveyor
"""

import io

from absl import flags

from experiments.output import prepare_output
from prism_jax.cli.launch import launch
from prism_jax.io.atomic import write_bytes
from prism_jax.simulation.contact_sheet import contact_sheet, shape_row
from prism_jax.simulation.kinds import MIXTURE
from prism_jax.simulation.roboarm.build import NUM_SEQUENCES, SPLITS
from prism_jax.simulation.roboarm.pictures import cell_row
from prism_jax.simulation.shapes import CATEGORIES
from prism_jax.simulation.view_pictures import kind_row

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum(
        "dataset", "shapes", ["shapes", "roboarm", "views"], "What to draw."
    )
    flags.DEFINE_string("output", "shapes.png", "The PNG to write.")
    flags.DEFINE_enum("split", "test", SPLITS, "Whose robot cells.")
    flags.DEFINE_integer("sequences", NUM_SEQUENCES, "Robot cells to draw.", 1)
    flags.DEFINE_multi_enum("category", CATEGORIES, CATEGORIES, "Which shapes.")
    flags.DEFINE_integer(
        "seed", 0, "Seed of the cells, or the first of the seeds in a row.", 0
    )
    flags.DEFINE_integer("seeds", 4, "Shapes in a row.", 1)
    flags.DEFINE_integer("columns", 2, "Rows side by side.", 1)
    flags.DEFINE_integer("size", 96, "Pixels of a picture's side.", 16, 1024)
    flags.DEFINE_integer("colors", 128, "Colours of the PNG's palette.", 2, 256)


def main():
    """One row a category, steel-blue ones for training; or a robot cell; or a kind."""
    prepare_output(FLAGS.output, ".png")
    if FLAGS.dataset == "roboarm":
        cells = range(FLAGS.sequences)
        rows = [cell_row(FLAGS.split, i, FLAGS.seed, FLAGS.size) for i in cells]
    elif FLAGS.dataset == "views":
        shapes = FLAGS.category, FLAGS.seed, FLAGS.size
        rows = [kind_row(kind, *shapes) for kind in MIXTURE]
    else:
        seeds = range(FLAGS.seed, FLAGS.seed + FLAGS.seeds)
        rows = [shape_row(name, seeds, FLAGS.size) for name in FLAGS.category]
    sheet = contact_sheet(rows, FLAGS.columns).quantize(FLAGS.colors)
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG", optimize=True)
    write_bytes(FLAGS.output, buffer.getvalue())
    print(FLAGS.output)


def run():
    """The entry point."""
    define_flags()
    launch("contact_sheet", main)


if __name__ == "__main__":
    run()
