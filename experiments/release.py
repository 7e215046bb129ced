"""Adds a run's weights to the package, with their scores in the metadata.

python -m experiments.release --weights=FILE --scores=EVALUATION.json \
    --calibration=CALIBRATION.json --name=small

Existing scores, notes and calibration are kept unless given.
"""

import json
import pathlib
from typing import Any

from absl import flags

from experiments.settings import changed
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import (
    SUFFIX,
    file_sha256,
    load_pretrained,
    read_metadata,
    save_weights,
)
from prism_jax.io.atomic import make_output_dir
from prism_jax.io.errors import InputError

FLAGS = flags.FLAGS
ASSETS = pathlib.Path(__file__).parents[1] / "prism_jax" / "assets"
FITTED = ("calibration", "trust", "point_errors", "sigma")
"""What experiments.calibrate adds: two fits, and how far each is right."""


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string(
        "weights", None, "Weights file of a finished run.", required=True
    )
    flags.DEFINE_multi_string("scores", [], "JSON files of experiments.evaluate.")
    flags.DEFINE_string("calibration", None, "JSON file of experiments.calibrate.")
    flags.DEFINE_string("name", None, "Name of the released weights.", required=True)
    flags.DEFINE_string("output_dir", str(ASSETS), "Output folder.")
    flags.DEFINE_multi_string("set", [], "Settings to change: path.to.field=value.")
    flags.DEFINE_multi_string("note", [], "Note for the model card.")


def main():
    """Copies the arrays, and adds scores and notes to what is known of them."""
    config, variables = load_pretrained(FLAGS.weights)
    config = changed(config, FLAGS.set)
    about = {k: v for k, v in read_metadata(FLAGS.weights).items() if k != "config"}
    results = [_scores(path) for path in FLAGS.scores]
    scores = {f"{found['data']}-{found['split']}": found for found in results}
    about["scores"] = scores or about.get("scores", {})
    about["notes"] = FLAGS.note or about.get("notes", [])
    if FLAGS.calibration is not None:
        result = _result(FLAGS.calibration)
        about |= {name: result[name] for name in FITTED}
    path = make_output_dir(pathlib.Path(FLAGS.output_dir)) / f"{FLAGS.name}{SUFFIX}"
    save_weights(path, config, variables, about)
    print(f"written {path}, {path.stat().st_size / 1e6:.1f} MB")


def _scores(path: str) -> dict[str, Any]:
    """What an evaluation of these weights found, under the name that they get."""
    result = _result(path)
    del result["per_example"]
    return {**result, "weights": FLAGS.name}


def _result(path: str) -> dict[str, Any]:
    result = json.loads(pathlib.Path(path).read_text())
    if result.get("weights_sha256") != file_sha256(FLAGS.weights):
        fault = f"made for {result['weights']}, not for the current {FLAGS.weights}"
        raise InputError(path, fault, "rerun it for the weights to release")
    return result


def run():
    """The entry point."""
    define_flags()
    launch("release", main)


if __name__ == "__main__":
    run()
