"""Draws a picture of the procedural shapes, the open ones, or the robot cells.

python -m experiments.contact_sheet --output=docs/shapes.png
python -m experiments.contact_sheet --dataset=open --size=128 \
    --output=docs/open_shapes.png
python -m experiments.contact_sheet --dataset=roboarm --output=cells.png
"""

import io

from absl import flags

from experiments.output import prepare_output
from prism_jax.cli.launch import launch
from prism_jax.io.atomic import write_bytes
from prism_jax.simulation.contact_sheet import contact_sheet, open_row, shape_row
from prism_jax.simulation.roboarm.build import NUM_SEQUENCES, SPLITS
from prism_jax.simulation.roboarm.pictures import cell_row
from prism_jax.simulation.shapes import CATEGORIES

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum("dataset", "shapes", ["shapes", "open", "roboarm"], "Of what.")
    flags.DEFINE_string("output", "shapes.png", "The PNG to write.")
    flags.DEFINE_enum("split", "test", SPLITS, "Whose robot cells.")
    flags.DEFINE_integer("sequences", NUM_SEQUENCES, "Robot cells to draw.", 1)
    flags.DEFINE_integer("rows", 10, "Rows of open shapes.", 1)
    flags.DEFINE_multi_enum("category", CATEGORIES, CATEGORIES, "Which shapes.")
    flags.DEFINE_integer(
        "seed", 0, "Seed of the cells, or the first of the seeds in a row.", 0
    )
    flags.DEFINE_integer("seeds", 4, "Shapes in a row.", 1)
    flags.DEFINE_integer("columns", 2, "Rows side by side.", 1)
    flags.DEFINE_integer("size", 96, "Pixels of a picture's side.", 16, 1024)
    flags.DEFINE_integer("colors", 128, "Colours of the PNG's palette.", 2, 256)


def main():
    """One row a category, steel-blue ones for training; or rows of open shapes, seed
    after seed; or one row a robot cell."""
    prepare_output(FLAGS.output, ".png")
    if FLAGS.dataset == "roboarm":
        cells = range(FLAGS.sequences)
        rows = [cell_row(FLAGS.split, i, FLAGS.seed, FLAGS.size) for i in cells]
    elif FLAGS.dataset == "open":
        starts = range(FLAGS.seed, FLAGS.seed + FLAGS.rows * FLAGS.seeds, FLAGS.seeds)
        rows = [open_row(range(s, s + FLAGS.seeds), FLAGS.size) for s in starts]
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
