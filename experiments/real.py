"""Completes every real scan of a folder, scores what has a truth, and draws pictures.

python -m experiments.real --data_dir=../shared/real --weights=small \
    --output=docs/tables/real.json --picture=docs/real.png

What cannot be read, and a recording whose package is not installed, is left out and
told in one line.
"""

import io
import pathlib
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from absl import flags
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.real_pictures import picture_row
from experiments.real_specs import CHECKS, SPECS, Done, Given, Spec, check_folder
from experiments.scoring import print_and_write
from experiments.sheets import Row, contact_sheet
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completed import CompletedScan, CompletedScene
from prism_jax.completion import Completer
from prism_jax.evaluation.tables import short, table_lines
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.metrics import UNIT
from prism_jax.result import score
from prism_jax.training.run import commit

FLAGS = flags.FLAGS

ROUNDING = 1e-6
"""Of a workspace's half side: points so little beside it are not outside."""


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("data_dir", "../shared/real", "Folder of the real scans.")
    flags.DEFINE_multi_string("weights", ["small"], "Names or files; one or several.")
    flags.DEFINE_string("output", None, "JSON file to write.")
    flags.DEFINE_string(
        "picture", None, "PNG to write, a row for each scan that may be shown."
    )
    flags.DEFINE_integer("size", 200, "Pixels of a picture's side.", 16, 1024)
    flags.DEFINE_integer("columns", 2, "Rows of pictures side by side.", 1)


def main() -> None:
    """Completes, scores, writes and prints the table, and draws."""
    prepare_output(FLAGS.output, ".json")
    prepare_output(FLAGS.picture, ".png", "--picture")
    folder = pathlib.Path(FLAGS.data_dir)
    check_folder(folder)
    given, left_out = read_all(folder)
    completers = {
        name: Completer.from_pretrained(located(name)) for name in FLAGS.weights
    }
    rows, pictures = [], []
    with tqdm(total=len(given) * len(completers), unit="completion") as bar:
        for spec, scan in given.items():
            done: dict[str, Done] = {}
            for weights, completer in completers.items():
                bar.set_postfix_str(f"{spec.name}, {weights}")
                done[weights] = completed(completer, spec, scan)
                rows.append(row_of(spec, weights, scan, done[weights]))
                bar.update()
            if FLAGS.picture is not None and spec.is_drawn:
                pictures.append(
                    picture_row(label_of(spec.name, done), done, FLAGS.size)
                )
    if FLAGS.picture is not None:
        write_sheet(pictures)
    result = {"commit": commit(), "unit": UNIT, "left_out": left_out, "scans": rows}
    print_and_write(result, real_markdown(result))


def read_all(folder: pathlib.Path) -> tuple[dict[Spec, Given], dict[str, str]]:
    """The scans that there are, and why others are left out, by name.

    InputError if there is none at all.
    """
    given, left_out = {}, {}
    for spec in SPECS:
        try:
            given[spec] = spec.read(folder / spec.file)
        except InputError as error:
            left_out[spec.name] = str(error)
            print(f"{spec.name} is left out: {error}", file=sys.stderr)
    if not given:
        raise InputError(folder, "has none of the scans", "the lines above say why")
    return given, left_out


def completed(completer: Completer, spec: Spec, scan: Given) -> Done:
    """As a user's scan is."""
    asked = scan.points, scan.camera
    if not spec.is_scene:
        return completer.complete(*asked, up=spec.up, background=spec.background)
    scene = completer.split_scene(*asked, up=spec.up)
    return completer.complete_scene(*asked, up=spec.up, scene=scene)


def row_of(spec: Spec, weights: str, scan: Given, done: Done) -> dict[str, Any]:
    """What is told of one completion."""
    objects = objects_of(done)
    verdicts = [one.verdict for one in objects if one.verdict is not None]
    return {
        "scan": spec.name,
        "weights": weights,
        "up": spec.up,
        "background": spec.background,
        "points": len(scan.points),
        "objects": len(objects),
        "added": int((~done.observed).sum()),
        "outside": sum(map(num_outside, objects)),
        "strays": sum(one.left_away["stray"] for one in objects),
        "verdicts": [
            {"trust": v.trust, "expected_error": float(v.expected_error)}
            for v in verdicts
        ],
        "scores": None if scan.truth is None else score(done, scan.truth),
        "checks": {name: check(done) for name, check in scan.checks.items()},
    }


def objects_of(done: Done) -> Sequence[CompletedScan]:
    """Those of a scene, or the one."""
    return done.objects if isinstance(done, CompletedScene) else [done]


def num_outside(done: CompletedScan) -> int:
    """Added points outside the workspace."""
    unit = np.asarray(done.workspace.to_unit(done.points[~done.observed]))
    return int((np.abs(unit) > 1 + ROUNDING).any(axis=1).sum())


def label_of(name: str, done: Mapping[str, Done]) -> str:
    """What stands above a scan's pictures."""
    counts = [f"{w} adds {int((~one.observed).sum()):,}" for w, one in done.items()]
    measured = int(next(iter(done.values())).observed.sum())
    return f"{name}: {measured:,} points; {', '.join(counts)}"


def write_sheet(rows: Sequence[Row]) -> None:
    """The pictures in one file, a row for each scan."""
    buffer = io.BytesIO()
    sheet = contact_sheet(rows, FLAGS.columns).quantize(128)
    sheet.save(buffer, "PNG", optimize=True)
    write_bytes(FLAGS.picture, buffer.getvalue())


def real_markdown(result: Mapping[str, Any]) -> str:
    """A table of all scans, one of those with a truth, and one of what else they can be
    held against."""
    rows = result["scans"]
    made = f"commit {short(result['commit'] or 'unknown')}."
    lines = [f"{made} Unit of length of scores: {result['unit']}.\n"]
    lines += table_lines(_HEAD, map(_cells, rows))
    scored = [
        [row["scan"], f"`{row['weights']}`", cloud, *_scores(scores)]
        for row in rows
        if row["scores"] is not None
        for cloud, scores in row["scores"]["clouds"].items()
    ]
    checked = [
        [row["scan"], f"`{row['weights']}`", CHECKS[name].label, _values(name, values)]
        for row in rows
        for name, values in row["checks"].items()
    ]
    if scored:
        heads = [head for head, _, _ in _METRICS]
        lines += ["", *table_lines(["scan", "weights", "cloud", *heads], scored)]
    if checked:
        lines += ["", *table_lines(["scan", "weights", "what", "value"], checked)]
    for name, why in result["left_out"].items():
        lines += ["", f"Left out: {name} ({why})."]
    return "\n".join(lines) + "\n"


_HEAD = (
    "scan",
    "weights",
    "points",
    "objects",
    "added",
    "outside the workspace",
    "strays left away",
    "trust",
    "expected error",
)
_METRICS = (
    ("CD-L2 x1e4", "cd_l2", 1e4),
    ("prediction to truth x1e4", "prediction_to_truth", 1e4),
    ("truth to prediction x1e4", "truth_to_prediction", 1e4),
    ("CD-L1 x1e3", "cd_l1", 1e3),
    ("F@0.01", "f_score", 1.0),
    ("HD x1e2", "hausdorff", 1e2),
)


def _cells(row: Mapping[str, Any]) -> list[str]:
    counts = ("points", "objects", "added", "outside", "strays")
    trust = Counter(verdict["trust"] for verdict in row["verdicts"])
    errors = sorted({f"{v['expected_error']:.2g}" for v in row["verdicts"]}, key=float)
    return [
        row["scan"],
        f"`{row['weights']}`",
        *(f"{row[name]:,}" for name in counts),
        ", ".join(f"{trust[t]} {t}" for t in ("high", "fair", "low") if trust[t])
        or "-",
        " to ".join(dict.fromkeys([*errors[:1], *errors[-1:]])) or "-",
    ]


def _scores(scores: Mapping[str, float]) -> list[str]:
    return [f"{factor * scores[metric]:.4g}" for _, metric, factor in _METRICS]


def _values(check: str, values: Mapping[str, float]) -> str:
    factor = CHECKS[check].factor
    return ", ".join(f"{name}: {factor * value:.3g}" for name, value in values.items())


def run() -> None:
    """The entry point."""
    define_flags()
    launch("real", main)


if __name__ == "__main__":
    run()
