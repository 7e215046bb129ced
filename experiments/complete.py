"""Complete a partial scan, adapting the network to it.

    python -m experiments.complete --input scan.ply --output_dir out

or, installed, `prism-complete`. Without --input it completes a bundled sample. Writes
completed.ply, result.json and report.html. Ends with status 2 and one line on stderr
if the input cannot be used.
"""

import io
import sys
from collections.abc import Sequence
from typing import Any

from absl import app, flags, logging

from experiments.launch import keep_compiled
from prism_jax import completion_job
from prism_jax.completion_job import CompletionJob
from prism_jax.io import InputError

FLAGS = flags.FLAGS
LIST = "list"


def define_flags() -> None:
    """Define the flags; their defaults are those of CompletionJob."""
    default = CompletionJob()
    holders = [
        flags.DEFINE_string(
            "input",
            default.input,
            "Partial scan: .ply .pcd .npy .npz .xyz .txt .csv, or a 16-bit depth .png. "
            "A bundled sample if not given.",
        ),
        flags.DEFINE_string(
            "ground_truth", default.ground_truth, "Complete cloud to score against."
        ),
        flags.DEFINE_string(
            "camera",
            default.camera,
            "JSON of the camera that saw the scan. For a depth image: the .json of the "
            "same name if not given. For a cloud: one at the origin looking at it, or "
            "obliquely above if the origin is far away, as a map's is, or among the "
            "points.",
        ),
        flags.DEFINE_string(
            "workspace",
            default.workspace,
            "Box to crop the scan to, x0,y0,z0,x1,y1,z1 in the units of the input, and "
            "the ground truth alike. What is added may reach beyond it, within the "
            "cube that is completed: its side is 1.4 times the points' longest.",
        ),
        flags.DEFINE_enum(
            "up",
            default.up,
            ["x", "y", "z", "-x", "-y", "-z"],
            "Axis of the input that points upwards. If not given, -y for a depth "
            "image in its camera's own axes, and z for one whose camera is turned by "
            "10 degrees or more (--camera) and for a cloud.",
        ),
        flags.DEFINE_string(
            "weights",
            default.weights,
            f"Name of released weights, or a file of them; {LIST} prints what ships.",
        ),
        flags.DEFINE_bool(
            "adapt", default.adapt, "Adapt the network to the scan before completing."
        ),
        flags.DEFINE_string(
            "output_dir", default.output_dir, "Where the results are written."
        ),
    ]
    for holder in holders:
        # --help lists the flags of the program alone, and installed this is not it.
        FLAGS.register_key_flag_for_module(sys.argv[0], FLAGS[holder.name])


def main(argv: Sequence[str]) -> None:
    """Run the job that the flags describe."""
    try:
        if len(argv) > 1:
            raise InputError(argv[1], "is no flag", f"write --input={argv[1]}")
        if FLAGS.weights == LIST:
            print(shipped())
            return
        job = CompletionJob(
            input=FLAGS.input,
            ground_truth=FLAGS.ground_truth,
            camera=FLAGS.camera,
            workspace=FLAGS.workspace,
            up=FLAGS.up,
            weights=FLAGS.weights,
            adapt=FLAGS.adapt,
            output_dir=FLAGS.output_dir,
        )
        print(outcome(completion_job.run_job(job), job.output_dir))
    except InputError as error:
        completion_job.say(str(error))
        sys.exit(2)


def shipped() -> str:
    """A card of all weights that ship."""
    # It imports the data sets and the scores, which a completion does not wait for.
    from prism_jax.model_card import model_card
    from prism_jax.weights import available_weights

    return "\n".join(model_card(name) for name in available_weights())


def outcome(summary: dict[str, Any], output_dir: str) -> str:
    """What was done, in three lines."""
    points, adapted = summary["points"], "not asked for"
    if summary["adapt"] and len(summary["losses"]["objective"]) == 1:
        adapted = "none, these weights take no step"
    elif summary["adapt"]:
        adapted = "accepted" if summary["accepted"] else "not accepted, left out"
    return (
        f"points      {points['observed']:,} observed, {points['completed']:,} added\n"
        f"adaptation  {adapted}\n"
        f"written     {output_dir}: completed.ply, result.json, report.html"
    )


def parse_flags(argv: Sequence[str]) -> list[str]:
    """Parse the flags; what is wrong with them is one line, and exit status 2."""
    try:
        return FLAGS(argv)
    except flags.Error as error:
        completion_job.say(f"{' '.join(str(error).split())}; --help lists the flags")
        sys.exit(2)


def run() -> None:
    """The entry point of `prism-complete`."""
    define_flags()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A folder's name may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    keep_compiled()
    logging.set_verbosity(logging.WARNING)
    app.run(main, flags_parser=parse_flags)


if __name__ == "__main__":
    run()
