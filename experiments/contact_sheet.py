"""Draws the procedural shapes, one row per category, or open shapes:

python -m experiments.contact_sheet --output=docs/shapes.png
python -m experiments.contact_sheet --dataset=open --output=docs/open_shapes.png
"""

import io

import jax.numpy as jnp
import numpy as np
import trimesh
from absl import flags
from jaxtyping import UInt8

from experiments.output import prepare_output
from experiments.sheets import Row, contact_sheet, to_bytes
from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.raycast import Scene
from experiments.simulation.shapes import CATEGORIES, make_shape
from prism_jax.cli.launch import launch
from prism_jax.geometry.camera import Camera
from prism_jax.io.atomic import write_bytes

FLAGS = flags.FLAGS

STEEL = np.array([0.55, 0.66, 0.8])
TOWARD_VIEWER, TOWARD_LIGHT = np.array([3.2, 4.0, 2.5]), np.array([0.4, 0.3, 0.85])


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum("dataset", "shapes", ["shapes", "open"], "Data set to draw.")
    flags.DEFINE_string("output", "shapes.png", "PNG to write.")
    flags.DEFINE_multi_enum("category", CATEGORIES, CATEGORIES, "Categories of shapes.")
    flags.DEFINE_integer("rows", 10, "Rows of open shapes.", 1)
    flags.DEFINE_integer("seeds", 4, "Shapes per row.", 1)
    flags.DEFINE_integer("columns", 2, "Rows side by side.", 1)
    flags.DEFINE_integer("size", 96, "Side of a picture in pixels.", 16, 1024)


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


def draw(mesh: trimesh.Trimesh, size: int) -> UInt8[np.ndarray, "S S 3"]:
    """A mesh on white, shaded, with the shadows of one light: z is up."""
    scene = Scene(mesh)
    corners = ((mesh.vertices - scene.center) / scene.radius).astype(np.float32)
    scene = Scene(trimesh.Trimesh(corners, mesh.faces, process=False))
    camera = Camera.framing(jnp.asarray(corners), TOWARD_VIEWER, 1.1, size, size)
    rows, columns = np.indices((size, size))
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3)
    rays = np.asarray(np.linalg.solve(camera.intrinsics, pixels.T).T @ camera.rotation)
    hits = scene.cast(np.asarray(camera.position), rays)
    normals = scene.normals[hits.faces]
    normals[np.sum(normals * rays[hits.ray], axis=1) > 0] *= -1
    lit = np.clip(normals @ TOWARD_LIGHT, 0, None)
    toward = np.tile(TOWARD_LIGHT, (len(normals), 1))
    lit[scene.cast(hits.points + 1e-3 * normals, toward).ray] = 0
    picture = np.ones((len(rays), 3))
    light = 0.35 + 0.25 * hits.cosines + 0.4 * lit
    picture[hits.ray] = light[:, None] * STEEL
    return to_bytes(picture.reshape(size, size, 3))


def run():
    """The entry point."""
    define_flags()
    launch("contact_sheet", main)


if __name__ == "__main__":
    run()
