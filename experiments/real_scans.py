"""Scores completions of real scans whose true shape is known.

python -m experiments.real_scans --input=scan_000.ply --input=scan_090.ply \
    --ground_truth=complete.ply --up=y --output=docs/tables/real_scans.json
"""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

from absl import flags

from experiments.output import prepare_output
from experiments.weights import located
from prism_jax import io
from prism_jax.cli.launch import launch
from prism_jax.completion import Completer
from prism_jax.evaluation.tables import short
from prism_jax.io.atomic import write_bytes
from prism_jax.result import score
from prism_jax.training.run import commit

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_multi_string("input", None, "Partial scans.", required=True)
    flags.DEFINE_string("ground_truth", None, "Their true shape.", required=True)
    flags.DEFINE_string("up", "z", "Axis of the scans that points upwards.")
    flags.DEFINE_multi_string(
        "weights", ["small", "small-robocell"], "Names or files; one or several."
    )
    flags.DEFINE_string("output", None, "JSON file to write; Markdown goes beside it.")


def main() -> None:
    """Completes every scan with all weights, scores, writes and prints the table."""
    prepare_output(FLAGS.output, ".json")
    truth = io.read_points(FLAGS.ground_truth)
    scans = {pathlib.Path(path).stem: io.read_scan(path) for path in FLAGS.input}
    rows = []
    for weights in FLAGS.weights:
        completer = Completer.from_pretrained(located(weights))
        for name, scan in scans.items():
            done = completer.complete(scan.points, scan.camera, up=FLAGS.up)
            row = {"scan": name, "points": len(scan.points), "weights": weights}
            row |= {"accepted": done.accepted, **score(done, truth)}
            rows.append(row)
    result = {"commit": commit(), "scans": rows}
    text = real_scans_markdown(result)
    print(text)
    if FLAGS.output is not None:
        path = pathlib.Path(FLAGS.output)
        write_bytes(path, json.dumps(result, indent=1).encode())
        write_bytes(path.with_suffix(".md"), text.encode())


def real_scans_markdown(result: Mapping[str, Any]) -> str:
    """A row for each scan and weights."""
    first = result["scans"][0]
    lines = [
        f"commit {short(result['commit'] or 'unknown')}. "
        f"Unit of length: {first['unit']}.\n",
        f"| scan | weights | {' | '.join(_COLUMNS)} |",
        f"| --- | --- |{' --- |' * len(_COLUMNS)}",
    ]
    for row in result["scans"]:
        cells = [
            f"{factor * row['clouds'][cloud][metric]:.4g}"
            for cloud, metric, factor in _COLUMNS.values()
        ]
        named = f"{row['scan']}, {row['points']:,} points | `{row['weights']}`"
        lines.append(f"| {named} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


_COLUMNS = {
    "CD-L2 x1e4, partial": ("partial", "cd_l2", 1e4),
    "CD-L2 x1e4, network": ("network", "cd_l2", 1e4),
    "CD-L2 x1e4, completed": ("completed", "cd_l2", 1e4),
    "F@0.01, partial": ("partial", "f_score", 1.0),
    "F@0.01, completed": ("completed", "f_score", 1.0),
    "HD x1e2, partial": ("partial", "hausdorff", 1e2),
    "HD x1e2, completed": ("completed", "hausdorff", 1e2),
}


def run() -> None:
    """The entry point."""
    define_flags()
    launch("real_scans", main)


if __name__ == "__main__":
    run()
