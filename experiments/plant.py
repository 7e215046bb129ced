"""Adapts released weights to unlabelled frames of your own cells.

python -m experiments.plant --recordings=DIR --weights=small --output=FILE

docs/data.md describes the layout of recordings; ground truth is not used. Some measured
points are hidden, and the network learns to predict them. Every fifth sequence is held
out (or frame, if there are fewer than five sequences). If the error at hidden points of
those does not fall by a tenth, nothing is written and the status is 1.
"""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from absl import flags
from jaxtyping import Array, Float
from scipy.spatial import KDTree
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.plants.frames import (
    Cloud,
    PlantConfig,
    PlantFrame,
    hide,
    pseudo_label,
    read_frame,
    student_view,
)
from experiments.run_folder import commit
from experiments.settings import changed
from experiments.splits import digest_of
from experiments.training import known_of
from experiments.weights import located
from prism_jax.adaptation.objective import test_time_objective
from prism_jax.cli.launch import SomeFailed, launch
from prism_jax.completion.weights import (
    SUFFIX,
    file_sha256,
    load_pretrained,
    save_weights,
)
from prism_jax.data.datasets import open_dataset
from prism_jax.data.pipeline import Batch, Framing, stack
from prism_jax.evaluation.bootstrap import change_interval, resampled_means
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.geometry.neighbors import nearest
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import SQUARED_DISTANCE_FLOOR
from prism_jax.losses.primary import primary_loss
from prism_jax.models.config import ModelConfig
from prism_jax.models.prism import predict, prepare_input
from prism_jax.models.variables import ENCODERS, Variables
from prism_jax.preprocessing.observation import Observation, framed_view
from prism_jax.preprocessing.visibility import IN_FRONT, in_front
from prism_jax.training.optimisers import optimiser
from prism_jax.training.phase import TrainState
from prism_jax.training.supervised import averaged

FLAGS = flags.FLAGS

ADAM = optimiser("adam", 2e-4, 10**6, 1.0, 10, 1.0)  # any step may be the last
AVERAGE_DECAY = 0.98  # of the average, which teaches and is kept
FEW = 5  # one sequence in so many checks, or one frame where there are fewer sequences
LOOKS = 2  # fixed virtual occlusions of each frame that checks
NEARER = 0.1  # what was hidden must come nearer by more than so much, for certain
MORE = 0.04  # so many more predicted points may contradict what was measured


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("recordings", None, "Folder of your recordings.", required=True)
    flags.DEFINE_string("weights", "small", "Initial weights, name or file.")
    flags.DEFINE_string("output", None, "Weights to write.", required=True)
    flags.DEFINE_float("minutes", 15.0, "Time limit in minutes.", 0.0)
    flags.DEFINE_integer("steps", None, "Stop after this many steps instead.", 0)
    flags.DEFINE_integer("seed", 0, "Seed of frame order and occlusions.")
    flags.DEFINE_integer("frames", None, "Frames to use. Default: all.", 1)
    flags.DEFINE_multi_string("set", [], "Settings to change, such as whole=0.5.")


def main():
    """Adapts, checks, and writes the weights if they are better."""
    prepare_output(FLAGS.output, SUFFIX)
    config, variables = load_pretrained(located(FLAGS.weights))
    settings = changed(PlantConfig(), FLAGS.set)
    place = "recordings", "all", FLAGS.recordings
    # Of a part that is hidden it would be wrong to say that nothing is there.
    used = config.with_model(background="unknown")
    source = open_dataset(*place)
    count = min(FLAGS.frames or len(source), len(source))
    rows = np.linspace(0, len(source) - 1, count, dtype=int).tolist()
    frames = [read_frame(source, row, used.model) for row in rows]
    ending = FLAGS.steps, FLAGS.minutes if FLAGS.steps is None else np.inf
    adapted, told = adapt(used, variables, frames, settings, FLAGS.seed, *ending)
    print(words := in_words(told))
    if not told["check"]["passed"]:
        fault = "no certain 10 % gain on hidden points of held-out frames"
        remedy = "keep the old weights, or record more varied frames"
        raise SomeFailed([f"not written: {fault}; {remedy}"])
    # The calibration of the weights before is not theirs: they come without one.
    before, sha = known_of(FLAGS.weights), file_sha256(located(FLAGS.weights))
    about = {
        "preset": before.get("preset"),
        "seed": FLAGS.seed,
        "commit": commit(),
        "samples": told["steps"] * settings.batch_size,
        "pretrained": before,
        "adapted": {"from": FLAGS.weights, "sha256": sha, **told},
        "notes": [f"Adapted without labels from {FLAGS.weights}. {words}"],
        "data": place[0],
        "digest": digest_of(*place),
    }
    save_weights(FLAGS.output, config, adapted, about)
    print(f"written {FLAGS.output}")


def in_words(told: dict[str, Any]) -> str:
    """What was done, and what the held-out frames say."""
    change, low, high = (f"{100 * x:+.1f}" for x in told["check"]["change"])
    before, after = told["check"]["contradicted"]
    return (
        f"{told['steps']:,} steps on {told['frames']:,} frames without truth. On "
        f"others the distance to what was hidden changes by {change} % "
        f"[{low}, {high}], and {after:.1%} of points contradict the view, "
        f"{before:.1%} before."
    )


def adapt(config, variables, frames, settings, seed, steps, minutes=np.inf):
    """Trains for so many steps or minutes, of which checking is a part.

    Returns the average of the variables, which was the teacher, and what is told of it.
    After n steps both are a function of the arguments and n, whatever ended them. A
    loss that is not a number raises FloatingPointError.
    """
    started, model = time.monotonic(), config.model
    train, checks = held_out(frames)
    before = evidence(variables, checks, model)
    ends = 60.0 * minutes + started - (time.monotonic() - started)
    moved = {name: variables["params"][name] for name in (*ENCODERS, "decoder")}
    state = TrainState(jnp.int32(0), moved, ADAM.init(moved), moved)
    size = settings.num_label + settings.num_hidden
    framing = Framing(model.backbone.num_points, size, model.margin, model.heading)
    with tqdm(total=steps, desc="adapt", unit="step", mininterval=2.0) as bar:
        while bar.n != steps and time.monotonic() < ends:
            rng, views = np.random.default_rng((seed, 1, bar.n)), []
            teacher = put(variables, state.kept)
            for row in rows_of(bar.n, settings.batch_size, len(train), seed):
                points, frame = complete(teacher, train[row].seen, model), train[row]
                asked = pseudo_label(frame, points, settings), settings, framing
                views.append(student_view(frame.example, *asked, rng))
            key = jax.random.fold_in(jax.random.key(seed), bar.n)
            state, loss = step(variables, state, stack(views), key, config, settings)
            if not np.isfinite(loss):
                raise FloatingPointError(f"adapt: loss {loss} at step {bar.n}")
            bar.update()
    adapted = put(variables, state.kept)
    check = verdict(before, evidence(adapted, checks, model))
    told = {"frames": len(train), "steps": bar.n, "settings": vars(settings)}
    return adapted, {**told, "check": check}


def put(variables: Variables, moved: Variables) -> Variables:
    """The variables with other parameters of some parts."""
    return {**variables, "params": {**variables["params"], **moved}}


def rows_of(step: int, size: int, count: int, seed: int) -> list[int]:
    """Of a step's batch: every frame comes once before any comes again."""
    places = (divmod(n, count) for n in range(step * size, (step + 1) * size))
    draw = np.random.default_rng
    return [draw((seed, 0, epoch)).permutation(count)[n] for epoch, n in places]


def held_out(frames: list[PlantFrame]) -> tuple[list[PlantFrame], list[PlantFrame]]:
    """Those to train on, and those that check: all of every fifth sequence, or every
    fifth frame where sequences are fewer. Fewer than five raise InputError."""
    if len(frames) < FEW:
        fault = f"{len(frames)} frames are too few to hold some out"
        raise InputError("recordings", fault, f"record {FEW} or more")
    numbers = np.unique([each.object for each in frames], return_inverse=True)[1]
    numbers = numbers if numbers.max() >= FEW - 1 else np.arange(len(frames))
    parts = ([], [])
    for frame, number in zip(frames, numbers, strict=True):
        parts[int(number % FEW == FEW // 2)].append(frame)
    return parts


def complete(variables: Variables, seen: Observation, model: ModelConfig) -> Cloud:
    """What the network predicts in the unit workspace, not adapted to the frame."""
    arrays = (jnp.asarray(each, jnp.float32) for each in (seen.partial, seen.eye))
    return np.asarray(_points(variables, *arrays, model), np.float64)


@functools.partial(jax.jit, static_argnames="model")
def _points(variables, partial, eye, model):
    camera = framed_view(partial, eye)
    inputs = prepare_input(partial, camera, jax.random.key(0), model)
    return predict(variables, inputs, model).points


@functools.partial(jax.jit, static_argnames=("config", "settings"))
def step(fixed, state: TrainState, batch: Batch, key, config, settings):
    """The next state, of what moves, and the loss before it on a batch of
    `student_view`s. ``fixed`` has all variables that training began with."""
    loss_fn = functools.partial(student_loss, config=config, settings=settings)
    loss, grads = jax.value_and_grad(loss_fn)(state.variables, fixed, batch, key)
    updates, opt_state = ADAM.update(grads, state.opt_state)
    moved: Any = optax.apply_updates(state.variables, updates)
    average = averaged(state, moved, AVERAGE_DECAY)
    return TrainState(state.step + 1, moved, opt_state, average), loss


def student_loss(moved, fixed, batch, key, config, settings) -> Float[Array, ""]:
    """Eq. 10 towards the pseudo-labels, the way to the prediction from what was hidden,
    which stands behind them in ``batch.complete``, and Eq. 13."""

    def one(partial, eye, wanted, key):
        camera = framed_view(partial, eye)
        inputs = prepare_input(partial, camera, key, config.model)
        if settings.auxiliary_weight:
            losses, prediction = test_time_objective(variables, inputs, config)
            auxiliary = settings.auxiliary_weight * losses.objective
        else:
            prediction, auxiliary = predict(variables, inputs, config.model), 0.0
        label, hidden = jnp.split(wanted, [settings.num_label])
        squared, _ = nearest(hidden, prediction.points)
        returned = jnp.sqrt(jnp.maximum(squared, SQUARED_DISTANCE_FLOOR)).mean()
        stages = (*prediction.stages[:-1], prediction.points)
        loss = primary_loss(stages, label, "l1")
        return loss + settings.hidden_weight * returned + auxiliary

    variables, keys = put(fixed, moved), jax.random.split(key, len(batch.partial))
    return jax.vmap(one)(batch.partial, batch.eye, batch.complete, keys).mean()


def evidence(variables, frames: list[PlantFrame], model) -> Float[np.ndarray, "L 3"]:
    """Of `LOOKS` fixed virtual occlusions of each frame: its group, which is the
    sequence, or the frame where there are few; how far what was hidden is from the
    nearest predicted points, in half sides; and the share of those that would have
    hidden something which the sensor did measure."""
    several, rows = len({frame.object for frame in frames}) >= FEW, []
    for row, look in np.ndindex(len(frames), LOOKS):
        example, number, whole = frames[row]
        hidden, seen = hide(example, look, model)
        added = np.asarray(seen.workspace.from_unit(complete(variables, seen, model)))
        distance = KDTree(added).query(hidden)[0].mean() / seen.workspace.half_extent
        wrong = 0.0
        if example.eye is not None:
            few = np.asarray(whole.workspace.from_unit(whole.partial))
            ray = example.partial, example.eye, IndexedCloud(few).spacing, IN_FRONT
            wrong = in_front(added, *ray).mean()
        rows.append((number if several else row, distance, wrong))
    return np.array(rows, np.float64)


def verdict(before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Whether new variables are better by their `evidence`, and what says so: the 95 %
    interval of the change of the distance of what was hidden lies below -`NEARER`, and
    at most `MORE` predicted points more contradict what was measured."""
    groups = np.unique(before[:, 0], return_inverse=True)[1]
    pairs = np.stack([before[:, 1], after[:, 1]], axis=1)
    interval = change_interval(resampled_means(pairs, groups))
    hidden = pairs.mean(0).tolist()
    wrong = [float(each[:, 2].mean()) for each in (before, after)]
    return {
        "passed": bool(interval[1] < -NEARER and wrong[1] - wrong[0] <= MORE),
        "looks": len(pairs),
        "hidden": hidden,
        "change": [hidden[1] / max(hidden[0], 1e-12) - 1.0, *interval],
        "contradicted": wrong,
    }


def run():
    """The entry point."""
    define_flags()
    launch("plant", main)


if __name__ == "__main__":
    run()
