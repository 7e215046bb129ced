"""Draws a picture of shapes, views of them, scenes, robot cells, or people's models.

python -m experiments.contact_sheet --output=docs/shapes.png
python -m experiments.contact_sheet --dataset=open --size=128 \
    --output=docs/open_shapes.png
python -m experiments.contact_sheet --dataset=roboarm --output=cells.png
python -m experiments.contact_sheet --dataset=cells --split=train --columns=2 \
    --output=docs/new_cells.png
python -m experiments.contact_sheet --dataset=objects --columns=5 --output=objects.png
python -m experiments.contact_sheet --dataset=scenes --split=validation --size=200 \
    --columns=4 --colors=256 --output=docs/scenes.png
python -m experiments.contact_sheet --dataset=views --output=docs/views.png \
    --category=chair --category=gearbox --category=conveyor
"""

import io

import numpy as np
from absl import flags
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.simulation.contact_sheet import Row, contact_sheet, open_row, shape_row
from experiments.simulation.kinds import MIXTURE
from experiments.simulation.objects.build import NUM_VIEWS
from experiments.simulation.objects.catalogues import FOLDER
from experiments.simulation.objects.pictures import credit, model_row
from experiments.simulation.objects.survey import survey
from experiments.simulation.roboarm.build import NUM_SEQUENCES, SPLITS
from experiments.simulation.roboarm.cell_pictures import workcell_row
from experiments.simulation.roboarm.pictures import cell_row
from experiments.simulation.scenes.build import ScenesConfig
from experiments.simulation.scenes.pictures import scene_row
from experiments.simulation.scenes.things import pools_of
from experiments.simulation.shapes import CATEGORIES
from experiments.simulation.view_pictures import kind_row
from prism_jax.cli.launch import launch
from prism_jax.io.atomic import write_bytes

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    known = ["shapes", "open", "views", "scenes", "roboarm", "cells", "objects"]
    flags.DEFINE_enum("dataset", "shapes", known, "What to draw.")
    flags.DEFINE_string("output", "shapes.png", "The PNG to write.")
    flags.DEFINE_enum("split", "test", SPLITS, "Whose robot cells or scenes.")
    flags.DEFINE_integer("scenes", 20, "Scenes to draw.", 1)
    flags.DEFINE_integer("sequences", NUM_SEQUENCES, "Robot cells to draw.", 1)
    flags.DEFINE_integer("rows", 10, "Rows of open shapes.", 1)
    flags.DEFINE_integer("models", 40, "Models to draw, evenly spaced through all.", 1)
    flags.DEFINE_string("catalogue_dir", str(FOLDER), "Where the models are.")
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
    after seed; or one row a kind of view, a scene, a robot cell, or a model, whose
    makers are printed."""
    prepare_output(FLAGS.output, ".png")
    if FLAGS.dataset in ("roboarm", "cells"):
        row = cell_row if FLAGS.dataset == "roboarm" else workcell_row
        cells = tqdm(range(FLAGS.sequences), unit="cell")
        rows = [row(FLAGS.split, i, FLAGS.seed, FLAGS.size) for i in cells]
    elif FLAGS.dataset == "views":
        shapes = FLAGS.category, FLAGS.seed, FLAGS.size
        rows = [kind_row(kind, *shapes) for kind in MIXTURE]
    elif FLAGS.dataset == "scenes":
        config, pools = (
            ScenesConfig(FLAGS.split, seed=FLAGS.seed),
            pools_of(FLAGS.split),
        )
        scenes = range(FLAGS.scenes)
        rows = [scene_row(config, pools, i, FLAGS.size) for i in scenes]
    elif FLAGS.dataset == "objects":
        rows = model_rows()
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


def model_rows() -> list[Row]:
    """The rows of some models; prints whom each is by."""
    found = survey(list(NUM_VIEWS), FLAGS.catalogue_dir, progress=True).models
    picks = np.unique(np.linspace(0, len(found) - 1, FLAGS.models, dtype=int))
    models = [found[pick][0] for pick in picks]
    for model in models:
        print(credit(model))
    return [model_row(model, FLAGS.seed, FLAGS.size) for model in models]


def run():
    """The entry point."""
    define_flags()
    launch("contact_sheet", main)


if __name__ == "__main__":
    run()
