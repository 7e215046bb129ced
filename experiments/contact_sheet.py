"""Draws a picture of the procedural shapes, a row a category, or of open shapes:

python -m experiments.contact_sheet --output=docs/shapes.png
python -m experiments.contact_sheet --dataset=open --output=docs/open_shapes.png
"""

import io

from absl import flags

from experiments.output import prepare_output
from experiments.simulation.contact_sheet import Row, contact_sheet, draw
from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.shapes import CATEGORIES, make_shape
from prism_jax.cli.launch import launch
from prism_jax.io.atomic import write_bytes

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum("dataset", "shapes", ["shapes", "open"], "What to draw.")
    flags.DEFINE_string("output", "shapes.png", "The PNG to write.")
    flags.DEFINE_multi_enum("category", CATEGORIES, CATEGORIES, "Which shapes.")
    flags.DEFINE_integer("rows", 10, "Rows of open shapes.", 1)
    flags.DEFINE_integer("seeds", 4, "Shapes in a row.", 1)
    flags.DEFINE_integer("columns", 2, "Rows side by side.", 1)
    flags.DEFINE_integer("size", 96, "Pixels of a picture's side.", 16, 1024)


def main():
    """Writes the sheet and prints its path."""
    prepare_output(FLAGS.output, ".png")
    seeds, size = range(FLAGS.seeds), FLAGS.size
    rows = []
    if FLAGS.dataset == "shapes":
        for name in FLAGS.category:
            pictures = [draw(make_shape(name, seed), size) for seed in seeds]
            rows.append(Row(name.replace("_", " "), pictures))
    else:
        for start in range(0, FLAGS.rows * FLAGS.seeds, FLAGS.seeds):
            shapes = [make_open_shape(start + seed) for seed in seeds]
            label = f"{start} to {start + seeds[-1]}"
            rows.append(Row(label, [draw(shape, size) for shape in shapes]))
    buffer = io.BytesIO()
    sheet = contact_sheet(rows, FLAGS.columns).quantize(128)
    sheet.save(buffer, "PNG", optimize=True)
    write_bytes(FLAGS.output, buffer.getvalue())
    print(FLAGS.output)


def run():
    """The entry point."""
    define_flags()
    launch("contact_sheet", main)


if __name__ == "__main__":
    run()
