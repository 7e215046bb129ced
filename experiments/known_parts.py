"""Which parts are found again in simulated views, and what a user gains by it.

    python -m experiments.known_parts --split=validation --output=FILE.json

Parts are compositions of the shape generator, links of the split's arms and models of
its furniture catalogues. Each is seen once, as in `simulation.kinds`, upright or lying
anyhow, and sought in a library of itself and others, and in the same one without
itself. Another part that looks the same counts as right. `--seed` draws other
compositions, and other views of all parts.
"""

import contextlib
import dataclasses
import itertools
import time
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import trimesh
from absl import flags
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.run_folder import commit
from experiments.scoring import print_and_write
from experiments.simulation.kinds import make_view
from experiments.simulation.objects.survey import survey
from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.roboarm.models import ARMS
from experiments.simulation.roboarm.robots import Robot
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.assembly import with_model
from prism_jax.completion.completer import Completer
from prism_jax.completion.options import CompletionOptions
from prism_jax.envelope.surfaces import PART_MARGIN
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.visibility import NEARER
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError
from prism_jax.io.scan import standing_at
from prism_jax.registration.library import Found, Library, Model, prepared

FLAGS = flags.FLAGS

SEEDS = {"validation": 7 << 32, "test": 8 << 32}  # of the compositions, no training's
SIDES = 0.1, 1.0  # metres of a composition's longest side
THIN, SMALL = 0.02, 0.04  # metres: a link of a thinner or smaller mesh is left out
CENTIMETRES = 0.01  # of the catalogues' lengths
KINDS = ["clear", "noisy", "occluded", "truncated", "rings"]
KINDS += ["occluded+noisy", "truncated+noisy"]
NEAR, ENOUGH = 0.04, 1 / 3  # in longest sides, and of the surface: what was measured
SIZES = 1, 10, 100  # of libraries
RIGHT = 0.02  # in longest sides: so far from its place a surface may lie


class Part(NamedTuple):
    """A mesh in metres, what it is among, and the model that is made of it."""

    group: str
    mesh: Any
    model: Model


class Seen(NamedTuple):
    """What a sensor saw of a part, in the user's frame."""

    kind: str
    share: float  # of the surface that was measured
    pose: Float[np.ndarray, "4 4"]
    points: Float[np.ndarray, "N 3"]
    around: Float[np.ndarray, "R 3"]
    eye: Float[np.ndarray, "3"]
    complete: Float[np.ndarray, "M 3"]


def meshes_of(split: str, seed: int) -> Iterator[tuple[str, str, trimesh.Trimesh]]:
    """Names, groups and meshes of all parts."""
    for number in range(200 * seed, 200 * (seed + 1)):
        mesh = make_open_shape(SEEDS[split] + number)
        rng = np.random.default_rng(number)
        side = np.exp(rng.uniform(*np.log(SIDES)))
        mesh.apply_scale(side / np.ptp(mesh.vertices, axis=0).max())
        yield f"composition {number}", "compositions", mesh
    splits = ["test"] if split == "test" else ["train", "validation"]
    for arm in itertools.chain(*(ARMS[name] for name in splits)):
        robot = Robot(arm)
        for name, mesh in zip(robot.link_names, robot.meshes, strict=True):
            _, middle, longest = np.sort(np.ptp(mesh.vertices, axis=0))
            if longest > SMALL and middle > THIN:
                yield f"{arm.name} {name}", "links of arms", mesh
    for model, _ in survey(splits).models:
        yield model.identity, "furniture", model.load().apply_scale(CENTIMETRES)


def parts_of(split: str, seed: int = 0) -> list[Part]:
    """All parts whose surface can be seen from outside."""
    parts: list[Part] = []
    for name, group, mesh in tqdm([*meshes_of(split, seed)], "prepared"):
        with contextlib.suppress(InputError):
            model = prepared(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
            parts.append(Part(group, mesh, model))
    return parts


def seen_of(part: Part, seed: int = 0) -> Seen | None:
    """A view of a part, the same for one name and seed; None where nothing is seen."""
    rng = np.random.default_rng(zlib.crc32(part.model.name.encode()) + (seed << 32))
    vertices, faces = np.asarray(part.mesh.vertices), part.mesh.faces
    is_open = part.group == "furniture"
    try:
        surface = sample_outside(Scene(part.mesh), 16_384, rng, is_open)
    except ValueError:
        return None
    low, high = surface.min(axis=0), surface.max(axis=0)
    center, half = (low + high) / 2, (high - low).max() / 2
    unit = trimesh.Trimesh((vertices - center) / half, faces, process=False)
    scene, complete = Scene(unit), (surface - center) / half
    kind = str(rng.choice(KINDS))
    for _ in range(40):
        view = make_view(kind, scene, complete, rng, 2048)
        if len(view.points) >= 64:
            break
    else:
        return None
    upright = is_open or rng.random() < 0.5
    turn = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    turn = turn if upright else Rotation.from_quat(rng.normal(size=4))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), 6 * half * rng.uniform(-1, 1, 3)
    assert view.visibility is not None
    camera, state, depth = view.visibility
    around = points_from_depth(np.asarray(depth), np.asarray(state) >= NEARER, camera)

    share = float((KDTree(view.points).query(complete)[0] < 2 * NEAR).mean())
    clouds = [
        (cloud * half + center) @ pose[:3, :3].T + pose[:3, 3]
        for cloud in (view.points, around, view.eye, complete)
    ]
    return Seen(kind, share, pose, *clouds)


def placed(model: Model, pose: np.ndarray) -> np.ndarray:
    """All points of a model's surface in a pose."""
    points = model.surface.points + model.surface.middle
    return points @ pose[:3, :3].T + pose[:3, 3]


def error_of(found: Found, part: Part, seen: Seen) -> float:
    """How far the surface of what was found and the part's in its true pose lie from
    each other, in longest sides, but for a fiftieth of either: little in all poses that
    look right, and for another part that looks the same. Infinite for nothing."""
    if found.model is None or found.match is None:
        return np.inf
    points = placed(found.model, found.match.pose), placed(part.model, seen.pose)
    away = [KDTree(b).query(a[::10])[0] for a, b in (points, points[::-1])]
    return float(max(np.quantile(one, 0.98) for one in away) / part.model.surface.size)


def margin_of(found: Found, part: Part, seen: Seen) -> float | None:
    """The largest distance of the part's true surface from the points that an envelope
    has of what was found, in longest sides of that; None for nothing."""
    if found.model is None:
        return None
    away = KDTree(found.placed()[0]).query(placed(part.model, seen.pose))[0]
    return float(away.max() / found.model.surface.size)


def cd_l2(points: np.ndarray, complete: np.ndarray) -> float:
    """Times 10,000, in half the longest side of the true shape."""
    half = np.ptp(complete, axis=0).max() / 2
    both = KDTree(complete).query(points)[0], KDTree(points).query(complete)[0]
    return float(1e4 * sum((away**2).mean() for away in both) / half**2)


def row_of(
    completer: Completer, part: Part, others: list[Model], seed: int
) -> dict[str, Any]:
    """What became of one part in libraries with and without it."""
    seen = seen_of(part, seed)
    if seen is None:
        return {}
    camera, options = standing_at(seen.eye), CompletionOptions()
    plain = completer.complete(seen.points, camera, around=seen.around)
    task = completer.task(seen.points, camera, None, seen.around, options)

    def sought(*models: Model) -> tuple[Found, float, float]:
        # As if no object had been looked for before.
        surfaces = [dataclasses.replace(model.surface) for model in models]
        pairs = zip(models, surfaces, strict=True)
        models = tuple(dataclasses.replace(m, surface=one) for m, one in pairs)
        start = time.perf_counter(), time.process_time()
        found = completer.knowing(Library(models)).recognise(task, options)
        return found, time.perf_counter() - start[0], time.process_time() - start[1]

    timed = [sought(part.model, *others[: size - 1]) for size in SIZES]
    found, without = timed[-1][0], sought(*others)[0]
    full = with_model(plain, task, options, found)
    return {
        "part": part.model.name,
        "group": part.group,
        "kind": seen.kind,
        "share": seen.share,
        "named": found.model and found.model.name,
        "right": error_of(found, part, seen) < RIGHT,
        "margin": margin_of(found, part, seen),
        "why": found.refused.get(part.model.name),
        "instead": without.model and without.model.name,
        "false": without.model is not None and error_of(without, part, seen) > RIGHT,
        "cd_l2": [cd_l2(one.points, seen.complete) for one in (plain, full)],
        "seconds": [one[1:] for one in timed],
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """The tables: views, those that measured enough, of these the right ones, of all
    those in a wrong pose or taken for another part, the latter also if theirs is not
    there, and CD-L2 of the right ones. Then seconds, and how far the true surface lies
    from that of what was found."""
    head = ["parts", "views", "a third measured", "right", "wrong", "false"]
    head += ["network", "known"]
    cells = []
    groups = [("group", name) for name in dict.fromkeys(r["group"] for r in rows)]
    for field, name in [*groups, *(("kind", kind) for kind in KINDS), ("", "all")]:
        own = [row for row in rows if row.get(field, "all") == name]
        large = [row for row in own if row["share"] > ENOUGH]
        if large:
            right = [row["cd_l2"] for row in large if row["right"]]
            named = [row["named"] is not None and not row["right"] for row in own]
            wrong, false = np.mean(named), np.mean([row["false"] for row in own])
            told = [name, str(len(own)), str(len(large))]
            told += [f"{one:.1%}" for one in (len(right) / len(large), wrong, false)]
            cells.append(told + [f"{cd:.4g}" for cd in np.mean(right, axis=0)])
    seconds = np.median([row["seconds"] for row in rows], axis=0)
    sizes = [
        [str(n), f"{a:.2f}", f"{b:.2f}"]
        for n, (a, b) in zip(SIZES, seconds, strict=True)
    ]
    lines = table_lines(head, cells), table_lines(["models", "seconds", "CPU"], sizes)
    margins = np.array([r["margin"] for r in rows if r["margin"] is not None])
    near = ", ".join(
        f"{np.quantile(margins, q):.3f} ({q:.0%})" for q in (0.5, 0.9, 0.95)
    )
    told = f"true surface from what was found, in longest sides: {near}, "
    told += f"{(margins <= PART_MARGIN).mean():.1%} within {PART_MARGIN}"
    return "\n".join([*lines[0], "", *lines[1], "", told])


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum("split", "validation", list(SEEDS), "Parts of which split.")
    flags.DEFINE_string("weights", "small", "Weights, name or file.")
    flags.DEFINE_string("output", None, "JSON file to write.")
    flags.DEFINE_integer("every", 1, "One part in so many is sought.", 1)
    flags.DEFINE_integer("first", 0, "The first of them.", 0)
    flags.DEFINE_integer("seed", 0, "Of compositions and views.", 0)


def main() -> None:
    """Seeks every part, prints the tables and writes the result."""
    prepare_output(FLAGS.output, ".json")
    completer = Completer.from_pretrained(located(FLAGS.weights))
    parts, rows = parts_of(FLAGS.split, FLAGS.seed), []
    for number, part in enumerate(tqdm(parts, "sought")):
        if number % FLAGS.every == FLAGS.first:
            rng = np.random.default_rng(number)
            order = [i for i in rng.permutation(len(parts)) if i != number]
            others = [parts[i].model for i in itertools.islice(order, SIZES[-1] - 1)]
            rows.append(row_of(completer, part, others, FLAGS.seed))
    rows = [row for row in rows if row]
    about = {
        "commit": commit(),
        "split": FLAGS.split,
        "first": FLAGS.first,
        "seed": FLAGS.seed,
        "models": SIZES[-1],
    }
    print_and_write({**about, "rows": rows}, summary(rows))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("known_parts", main)


if __name__ == "__main__":
    run()
