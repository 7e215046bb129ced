"""From nothing, or from other weights, to weights that can ship: trains, compares,
scores, exports.

python -m experiments.train_release --preset=small --workdir=DIR [--weights=FILE]
"""

import dataclasses
import json
import pathlib
import signal
import subprocess
import sys
from typing import Any, NamedTuple

from absl import flags

from prism_jax.cli.launch import launch
from prism_jax.data.datasets import (
    DATASETS,
    open_dataset,
    parts_of,
    scored_splits,
)
from prism_jax.presets import resolve
from prism_jax.simulation.build_dataset import build_if_missing
from prism_jax.training.meta import check_meta
from prism_jax.training.run import open_run
from prism_jax.weights import SUFFIX, file_sha256

FLAGS = flags.FLAGS
WITHOUT_METHOD = (
    "meta.method.num_steps=0",
    "meta.method.lambda_aux=0.0",
    "meta.method.learn_steps=False",
    "meta.method.learn_auxiliary=False",
    "adapt.num_steps=0",
)
"""What makes the control of meta-training: as many samples of the same, no episodes."""


class Step(NamedTuple):
    """One command of the plan, and the file that says that it is done.

    Attributes:
      weights: the file that a command scores: what it wrote of another is not its own.
    """

    module: str
    arguments: tuple[str, ...]
    done: pathlib.Path
    weights: pathlib.Path | None = None

    @property
    def command(self) -> list[str]:
        return [sys.executable, "-m", f"experiments.{self.module}", *self.arguments]

    @property
    def is_done(self) -> bool:
        """A release takes a second, and is made again: its notes may be others."""
        if self.module == "release" or not self.done.exists():
            return False
        if self.weights is None:
            return True
        scored = json.loads(self.done.read_text()).get("weights_sha256")
        return scored == file_sha256(str(self.weights))


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("preset", "small", "Configuration: small, paper or plus.")
    flags.DEFINE_string("name", None, "Of the weights; the preset's if not given.")
    flags.DEFINE_string("weights", None, "To go on from; from nothing if not given.")
    flags.DEFINE_string("workdir", None, "Where everything goes.", required=True)
    flags.DEFINE_integer("seed", 0, "Seed of initialisation and data order.")
    flags.DEFINE_enum("dataset", "shapes", DATASETS, "What to train on.")
    flags.DEFINE_multi_enum(
        "scored", None, DATASETS, "What to score on; the same if not given."
    )
    flags.DEFINE_integer("scored_at_once", 20, "Examples, as memory allows.", 1)
    flags.DEFINE_string(
        "data_dir", None, "Folder of what is trained on; shapes and roboarm have one."
    )
    flags.DEFINE_string(
        "scored_dir", None, "Folder of what is scored on and not trained on, likewise."
    )
    flags.DEFINE_integer(
        "max_steps", None, "End the first leg that is longer at this step."
    )
    flags.DEFINE_multi_string("set", [], "Changes, as path.to.field=value.")
    flags.DEFINE_multi_string(
        "branches",
        [],
        "Meta-trained with the losses of these alone besides, as align,normal (Table "
        "III); again for others.",
    )
    flags.DEFINE_multi_string("note", [], "What else is to be known of the weights.")


def only(branches: str) -> str:
    """The change with which the losses of these branches count, and no others."""
    return f"meta.method.branches={tuple(branches.split(','))}"


def splits_to_score() -> list[tuple[str, str, str | None]]:
    """Data sets, their splits and folders: what is trained on has its own."""
    sets = FLAGS.scored or [FLAGS.dataset]
    splits = [(dataset, split) for dataset in sets for split in scored_splits(dataset)]
    trained = parts_of(FLAGS.dataset, FLAGS.data_dir)
    return [
        (name, split, FLAGS.data_dir if name in trained else FLAGS.scored_dir)
        for name, split in splits
    ]


def plan(folder: pathlib.Path) -> list[Step]:
    """What the flags ask for, in order. Every command goes on where it was broken off,
    and one whose last file is there is not run again."""
    name = FLAGS.name or FLAGS.preset
    place = [] if FLAGS.data_dir is None else [f"--data_dir={FLAGS.data_dir}"]
    changes = [f"--set={change}" for change in FLAGS.set]
    control = [f"--set={change}" for change in WITHOUT_METHOD]

    def training(module: str, name: str, *arguments: str) -> Step:
        run = folder / name
        resume = ["--resume"] if (run / "config.json").exists() else []
        common = [f"--preset={FLAGS.preset}", f"--seed={FLAGS.seed}", *changes]
        common += [f"--dataset={FLAGS.dataset}", *place]
        if FLAGS.max_steps is not None:
            common.append(f"--max_steps={FLAGS.max_steps}")
        arguments = (*common, *arguments, f"--workdir={run}", *resume)
        return Step(module, arguments, run / "weights.safetensors")

    def scores(weights: Step, dataset: str, split: str, where: str | None) -> Step:
        output = folder / f"{weights.done.parent.name}-{dataset}-{split}.json"
        what = [f"--weights={weights.done}", f"--dataset={dataset}", f"--split={split}"]
        what += [] if where is None else [f"--data_dir={where}"]
        how = [f"--batch_size={FLAGS.scored_at_once}", f"--output={output}"]
        return Step("evaluate", (*what, *how), output, weights.done)

    def release(weights: Step, scored: list[Step], name: str) -> Step:
        found = [f"--scores={step.done}" for step in scored]
        notes = [f"--note={note}" for note in FLAGS.note]
        named = (f"--name={name}", f"--output_dir={folder}", *notes)
        arguments = (f"--weights={weights.done}", *found, *named)
        return Step("release", arguments, folder / f"{name}{SUFFIX}")

    begun = [] if FLAGS.weights is None else [f"--weights={FLAGS.weights}"]
    pretrained = training("pretrain", "pretrained", *begun)
    start = f"--weights={pretrained.done}"
    meta = training("meta_train", "meta", start)
    alone = training("meta_train", "control", start, *control)
    trained = {name: meta, f"{name}-pretrained": alone}
    for branches in FLAGS.branches:
        label = branches.replace(",", "-")
        own = (start, f"--set={only(branches)}")
        trained[f"{name}-{label}"] = training("meta_train", f"meta-{label}", *own)
    steps = [pretrained, *trained.values()]
    splits = splits_to_score()
    for label, weights in trained.items():
        scored = [scores(weights, *split) for split in splits]
        steps += [*scored, release(weights, scored, label)]
    return steps


def check() -> None:
    """Finds the mistakes now that would else show after days; builds what is missing of
    what is scored on."""
    for changes in [[], *([only(branches)] for branches in FLAGS.branches)]:
        check_meta(resolve(FLAGS.preset, [*FLAGS.set, *changes]).meta)
    for place in splits_to_score():
        build_if_missing(*place)
        open_dataset(*place)


def settings() -> dict[str, Any]:
    """What the trainings depend on, but for the seed; their data they check."""
    preset = resolve(FLAGS.preset, FLAGS.set)
    start = None if FLAGS.weights is None else file_sha256(FLAGS.weights)
    return {
        "preset": dataclasses.asdict(preset),
        "start": start,
        "dataset": FLAGS.dataset,
    }


def main():
    """Runs what is not done yet, each command as its own process."""
    check()
    # `subprocess.run` kills its command when it is left by an exception.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    folder = open_run(FLAGS.workdir, settings(), FLAGS.seed, resume=True).resolve()
    steps = plan(folder)
    for number, step in enumerate(steps, start=1):
        label = f"{number}/{len(steps)} {step.module}: {step.done}"
        if step.is_done:
            print(f"{label} is there", flush=True)
            continue
        print(label, flush=True)
        ended = subprocess.run(step.command, check=False)
        if ended.returncode < 0:
            name = signal.Signals(-ended.returncode).name
            hint = "; for want of memory?" if name == "SIGKILL" else ""
            print(f"stopped by {name}{hint}; the same command goes on")
            sys.exit(128 - ended.returncode)
        if ended.returncode:
            sys.exit(ended.returncode)
        if not step.done.exists():
            print("stopped; the same command goes on, with more --max_steps or none")
            return
    print(f"written {', '.join(str(s.done) for s in steps if s.module == 'release')}")


def run():
    """The entry point."""
    define_flags()
    launch("train_release", main)


if __name__ == "__main__":
    run()
