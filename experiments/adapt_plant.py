"""Trains released weights on unlabelled frames of one's own cells.

python -m experiments.adapt_plant --recordings=DIR --weights=small --output=FILE

Recordings are laid out as docs/data.md says; their ground truth, if they have one, is
not used. Every fifth sequence, or frame where there are fewer than five, is held out,
and if what is hidden of those is not returned better by a tenth for certain, nothing is
written and the exit status is 1.
"""

from collections.abc import Mapping
from typing import Any

from absl import flags

from experiments.output import prepare_output
from experiments.plants.check import verdict
from experiments.plants.frames import Unlabelled, evenly
from experiments.plants.training import Adapted, PlantConfig, adapt
from experiments.settings import changed
from experiments.training import known_of
from experiments.weights import located
from prism_jax.cli.launch import SomeFailed, launch
from prism_jax.data.datasets import DATASETS, digest_of, open_dataset
from prism_jax.io.errors import InputError
from prism_jax.training.run import commit
from prism_jax.weights import SUFFIX, file_sha256, load_pretrained, save_weights

FLAGS = flags.FLAGS


def define_plant_flags() -> None:
    """The flags of a training on frames."""
    flags.DEFINE_string("weights", "small", "To start from, by name or by file.")
    flags.DEFINE_float("minutes", 15.0, "To end after.", 0.0)
    flags.DEFINE_integer(
        "steps", None, "To end after, however long they take; they decide the bytes.", 0
    )
    flags.DEFINE_integer("seed", 0, "Of the frames' order and the occlusions.")
    flags.DEFINE_integer("frames", None, "Evenly spaced, so many; all by default.", 1)
    flags.DEFINE_multi_string(
        "set", [], "Changes to how it is trained, as moves=decoder."
    )


def define_flags() -> None:
    """The flags of this launcher."""
    define_plant_flags()
    flags.DEFINE_string("recordings", None, "Folder of one's own recordings.")
    flags.DEFINE_enum("dataset", None, DATASETS, "A built set in their place.")
    flags.DEFINE_string("split", "validation", "Of --dataset.")
    flags.DEFINE_string("data_dir", None, "Folder of --dataset.")
    flags.DEFINE_string("output", None, "Weights to write.", required=True)


def main():
    """Adapts, checks, and writes the weights if they are better."""
    prepare_output(FLAGS.output, SUFFIX)
    if (FLAGS.recordings is None) == (FLAGS.dataset is None):
        remedy = "name a folder, or a built set"
        raise InputError("--recordings", "or --dataset, one of them, is needed", remedy)
    config, variables = load_pretrained(located(FLAGS.weights))
    settings = changed(PlantConfig(), FLAGS.set)
    place = FLAGS.dataset, FLAGS.split, FLAGS.data_dir
    if FLAGS.recordings is not None:
        place = "recordings", "all", FLAGS.recordings
    source = evenly(Unlabelled(open_dataset(*place)), FLAGS.frames)
    minutes = None if FLAGS.steps is not None else FLAGS.minutes
    adapted = adapt(
        config, variables, source, settings, FLAGS.seed, FLAGS.steps, minutes
    )
    better, told = verdict(adapted.before, adapted.after)
    print(in_words(adapted.steps, adapted.num_frames, told))
    if not better:
        raise SomeFailed([refusal(told)])
    about = about_adapted(adapted, settings, told)
    about |= {"data": place[0], "digest": digest_of(*place)}
    save_weights(FLAGS.output, config, adapted.variables, about)
    print(f"written {FLAGS.output}")


def in_words(steps: int, num_frames: int, told: Mapping[str, Any]) -> str:
    """What was done, and what the held-out frames say, in a sentence."""
    low, high = (100 * bound for bound in told["interval"])
    near, kept = ("{:.4f} to {:.4f}".format(*told[name]) for name in ("hidden", "kept"))
    shares = "{:.1%} to {:.1%}".format(*told["contradicted"])
    return (
        f"{steps:,} steps on {num_frames:,} frames without truth. On "
        f"{told['looks']:,} virtual occlusions of held-out frames the distance of what "
        f"was hidden went from {near} half sides ({100 * told['change']:+.1f} % "
        f"[{low:+.1f}, {high:+.1f}]), of what was seen from {kept}, and the share of "
        f"points that contradict the view from {shares}."
    )


def refusal(told: dict[str, Any]) -> str:
    """Why nothing is written, in one line."""
    return (
        "not written: held-out frames are not completed a tenth better for certain "
        f"(hidden {100 * told['change']:+.1f} %); keep the weights as they are if they "
        "know such cells, or record more varied frames, or train longer"
    )


def about_adapted(
    adapted: Adapted, settings: PlantConfig, told: dict[str, Any]
) -> dict[str, Any]:
    """The metadata of adapted weights: where they come from, and what speaks for them.

    The calibration of the weights before is not theirs, so they come without one.
    """
    before = known_of(FLAGS.weights)
    origin = f"Adapted without labels from {FLAGS.weights}."
    return {
        "preset": before.get("preset"),
        "seed": FLAGS.seed,
        "commit": commit(),
        "samples": adapted.steps * settings.batch_size,
        "pretrained": before,
        "adapted": {
            "from": FLAGS.weights,
            "sha256": file_sha256(located(FLAGS.weights)),
            "frames": adapted.num_frames,
            "sequences": adapted.num_sequences,
            "steps": adapted.steps,
            "settings": vars(settings),
            "check": told,
        },
        "notes": [f"{origin} {in_words(adapted.steps, adapted.num_frames, told)}"],
    }


def run():
    """The entry point."""
    define_flags()
    launch("adapt_plant", main)


if __name__ == "__main__":
    run()
