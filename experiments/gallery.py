"""Draws completions as a page and a picture, like the paper's figures 4 and 5.

python -m experiments.gallery --dataset=shapes --output=gallery.html
python -m experiments.gallery --dataset=roboarm --output=robots.html
"""

import io
import pathlib

import numpy as np
from absl import flags

from experiments.gallery_page import complete_items, gallery_page, picture_row
from experiments.output import prepare_output
from experiments.protocol import UNITS
from experiments.scoring import (
    define_frame_flags,
    make_protocol,
    open_split,
    prism_completer,
)
from experiments.sheets import contact_sheet
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import load_pretrained
from prism_jax.io.atomic import write_bytes

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    define_frame_flags(split="test", limit=18)
    flags.DEFINE_string(
        "output", "gallery.html", "Page to write, with a PNG next to it."
    )
    flags.DEFINE_string("weights", "small", "Released weights, name or file.")
    flags.DEFINE_integer("columns", 2, "Objects per row.", 1)
    flags.DEFINE_integer("size", 128, "Side of a picture in pixels.", 16, 1024)


def main():
    """Draws the first view of the first objects, as a page and as a picture."""
    prepare_output(FLAGS.output, ".html")
    config, variables = load_pretrained(located(FLAGS.weights))
    source, protocol = open_split(FLAGS.split), make_protocol(config)
    _, indices = np.unique(source.objects, return_index=True)
    indices = indices[: FLAGS.limit].tolist()
    shown = complete_items(
        prism_completer(config, variables), source, indices, protocol
    )
    page = pathlib.Path(FLAGS.output)
    caption = (
        f"{FLAGS.weights} on {FLAGS.dataset}, {FLAGS.split}: the first {len(shown)} "
        f"objects. Unit of length: {UNITS[protocol.unit]}."
    )
    write_bytes(page, gallery_page(shown, caption).encode())
    rows = [picture_row(item, FLAGS.size) for item in shown]
    buffer = io.BytesIO()
    sheet = contact_sheet(rows, FLAGS.columns).quantize(128)
    sheet.save(buffer, "PNG", optimize=True)
    write_bytes(page.with_suffix(".png"), buffer.getvalue())
    print(f"written {page} and {page.with_suffix('.png')}")


def run():
    """The entry point."""
    define_flags()
    launch("gallery", main)


if __name__ == "__main__":
    run()
