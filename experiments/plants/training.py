"""Label-free training of a released network on frames: student, teacher, loss."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from tqdm import tqdm

from experiments.plants.check import Evidence, gather, make_predictor
from experiments.plants.frames import (
    Frame,
    held_out,
    pseudo_label,
    read_frames,
    student_view,
)
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import test_time_objective
from prism_jax.data.pipeline import Batch, Framing, stack
from prism_jax.data.source import Source
from prism_jax.evaluation.protocol import side_by_side
from prism_jax.geometry.neighbors import nearest
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import SQUARED_DISTANCE_FLOOR
from prism_jax.models.prism import Prediction, predict, prepare_input
from prism_jax.models.ranges import check_ranges
from prism_jax.models.variables import ENCODERS, Variables
from prism_jax.observation.observation import observe
from prism_jax.training.config import RATE, SAMPLES
from prism_jax.training.optimisers import optimiser
from prism_jax.training.phase import TrainState
from prism_jax.training.supervised import averaged

MOVED = {
    "everything": (*ENCODERS, "decoder"),
    "encoders": ENCODERS,
    "decoder": ("decoder",),
}
"""The parts of the network that each choice moves."""

TERMS = ("cover", "toward", "hidden", "auxiliary", "loss")

MANY = 10**6
"""Steps that no training makes: the step size knows of no end."""


@dataclasses.dataclass(frozen=True)
class PlantConfig:
    """How a released network is trained on frames without truth.

    Attributes:
      moves: which parts of it move.
      batch_size: frames a step.
      learning_rate: Adam's step size, which stays after the warm-up: the training may
        end at any step, and its average is what counts.
      warmup_steps: in which it rises from zero.
      clip_norm: bound on the gradient's global norm; 0 for none.
      average_decay: of the moving average of the variables, which is the teacher, and
        what is kept.
      num_label: points of a pseudo-label that the losses look at.
      num_hidden: points of what was hidden that they look at.
      reach: how far from all that was measured the teacher may add points to a label,
        in half sides of the workspace.
      whole: the share of frames that the student reads without virtual occlusion.
      toward_weight: of the way from the prediction to the pseudo-label, against the
        way back.
      hidden_weight: of the way from what was hidden to the prediction.
      auxiliary_weight: of the objective of Eq. 13.
    """

    moves: Literal["everything", "encoders", "decoder"] = "everything"
    batch_size: int = 8
    learning_rate: float = 2e-4
    warmup_steps: int = 10
    clip_norm: float = 1.0
    average_decay: float = 0.98
    num_label: int = 2048
    num_hidden: int = 512
    reach: float = 0.15
    whole: float = 0.25
    toward_weight: float = 1.0
    hidden_weight: float = 0.25
    auxiliary_weight: float = 0.01

    def __post_init__(self):
        check_ranges(
            self,
            batch_size=(1, 2**16),
            learning_rate=RATE,
            warmup_steps=SAMPLES,
            clip_norm=(0, 1e6),
            average_decay=(0, 1),
            num_label=(1, 2**20),
            num_hidden=(1, 2**20),
            reach=(0, 1e3),
            whole=(0, 1),
            toward_weight=(0, 1e6),
            hidden_weight=(0, 1e6),
            auxiliary_weight=(0, 1e6),
        )


class Adapted(NamedTuple):
    """What a training on frames leaves.

    Attributes:
      variables: the average, which was the teacher.
      steps: that were made.
      num_frames: that were trained on.
      num_sequences: that all frames are of.
      before, after: what the frames that were held out say of the variables that it
        began with, and of these.
    """

    variables: Variables
    steps: int
    num_frames: int
    num_sequences: int
    before: Evidence
    after: Evidence


def adapt(
    config: PrismConfig,
    variables: Variables,
    source: Source,
    settings: PlantConfig,
    seed: int,
    steps: int | None = None,
    minutes: float | None = None,
) -> Adapted:
    """Trains on the frames of a source for so many steps, or minutes, or both.

    The frames' ground truth is not looked at. What is left after n steps is a function
    of the arguments and n: minutes only say when to end, the checks before and after
    being part of them. A source of too few frames raises InputError, and a loss that is
    not a number FloatingPointError.
    """
    started = time.monotonic()
    if steps is None and minutes is None:
        raise ValueError("say for how many steps or minutes")
    config = told_nothing(config)
    frames = read_frames(source, config)
    objects = np.array([frame.object for frame in frames])
    rows, checking = held_out(objects)
    train, check = ([frames[row] for row in part] for part in (rows, checking))
    predict_fn = make_predictor(config)
    checked = time.monotonic()
    before = gather(predict_fn, variables, check, config)
    checked = time.monotonic() - checked
    left = np.inf if minutes is None else 60.0 * minutes - checked
    step_fn, state = make_step(config, variables, settings)
    orders = _orders(len(train), settings.batch_size, seed)
    bar = tqdm(
        total=steps, desc="adapt", unit="step", mininterval=2.0, disable=steps == 0
    )
    done = 0
    while done != steps and time.monotonic() - started < left:
        batch_frames = [train[row] for row in next(orders)]
        seen = side_by_side([frame.seen for frame in batch_frames])
        teacher = put(variables, state.kept)
        labels = jax.device_get(predict_fn(teacher, *seen))
        rng = np.random.default_rng((seed, 1, done))
        batch = student_batch(batch_frames, labels, config, settings, rng)
        key = jax.random.fold_in(jax.random.key(seed), done)
        state, losses = step_fn(variables, state, batch, key)
        losses = dict(zip(TERMS, np.asarray(losses).tolist(), strict=True))
        if not np.isfinite(losses["loss"]):
            raise FloatingPointError(f"adapt: loss {losses['loss']} at step {done}")
        done += 1
        bar.update()
        bar.set_postfix(
            {name: f"{value:.4f}" for name, value in losses.items()}, refresh=False
        )
    bar.close()
    adapted = put(variables, state.kept)
    after = gather(predict_fn, adapted, check, config)
    sequences = len(np.unique(objects))
    return Adapted(adapted, done, len(train), sequences, before, after)


def told_nothing(config: PrismConfig) -> PrismConfig:
    """The same, where nobody says what lies around a cloud: of a part that is hidden
    it would be wrong to say that nothing is there."""
    model = dataclasses.replace(config.model, background="unknown")
    return dataclasses.replace(config, model=model)


def put(variables: Variables, moved: Variables) -> Variables:
    """The variables with other parameters of some parts."""
    return {**variables, "params": {**variables["params"], **moved}}


def student_batch(
    frames: Sequence[Frame],
    predictions: Float[np.ndarray, "B P 3"],
    config: PrismConfig,
    settings: PlantConfig,
    rng: np.random.Generator,
) -> Batch:
    """`student_view` of several frames, of whose wholes the teacher predicts this."""
    model = config.model
    count = settings.num_label + settings.num_hidden
    framing = Framing(model.backbone.num_points, count, model.margin, model.heading)
    rows = []
    for frame, points in zip(frames, predictions, strict=True):
        label = pseudo_label(frame, points, settings.num_label, settings.reach)
        asked = settings.num_hidden, settings.whole
        rows.append(student_view(frame, label, *asked, framing, rng))
    return stack(rows)


def make_step(
    config: PrismConfig, variables: Variables, settings: PlantConfig
) -> tuple[Callable[..., tuple[TrainState, Float[Array, " T"]]], TrainState]:
    """The jitted step, and the state that it begins with.

    The step takes the variables that training began with, of which what does not move
    stays, the state, a batch of `student_batch` and a key, and returns the next state
    and the `TERMS` of the loss before it. The state's variables are what moves.
    """
    parts = MOVED[settings.moves]
    adam = optimiser(
        "adam",
        settings.learning_rate,
        MANY,
        1.0,
        settings.warmup_steps,
        settings.clip_norm,
    )

    weights = np.array(
        [
            0.5,
            0.5 * settings.toward_weight,
            settings.hidden_weight,
            settings.auxiliary_weight,
        ],
        np.float32,
    )
    with_auxiliary = settings.auxiliary_weight > 0

    def loss_fn(moved, fixed, batch: Batch, keys: Array, weights: Array):
        fn = jax.vmap(
            lambda *frame: frame_losses(
                put(fixed, moved), *frame, config, settings.num_label, with_auxiliary
            )
        )
        arrays = map(jnp.asarray, (batch.partial, batch.eye, batch.complete))
        terms = fn(*arrays, keys).mean(0)
        loss = weights @ terms
        return loss, jnp.append(terms, loss)

    # The weights are an argument: other weights need no other compilation.
    @jax.jit
    def step(fixed, state: TrainState, batch: Batch, key: Array, weights: Array):
        keys = jax.random.split(key, len(batch.partial))
        grads, terms = jax.grad(loss_fn, has_aux=True)(
            state.variables, fixed, batch, keys, weights
        )
        updates, opt_state = adam.update(grads, state.opt_state)
        moved: Any = optax.apply_updates(state.variables, updates)
        average = averaged(state, moved, settings.average_decay)
        return TrainState(state.step + 1, moved, opt_state, average), terms

    moved = {name: variables["params"][name] for name in parts}
    start = TrainState(jnp.int32(0), moved, adam.init(moved), moved)
    return lambda *arguments: step(*arguments, weights), start


def frame_losses(
    variables: Variables,
    partial: Float[Array, "N 3"],
    eye: Float[Array, "3"],
    wanted: Float[Array, "M 3"],
    key: Array,
    config: PrismConfig,
    num_label: int,
    with_auxiliary: bool = True,
) -> Float[Array, "4"]:
    """The `TERMS` of one frame but their sum, in the student's unit workspace.

    `wanted` is the pseudo-label and, behind its `num_label` points, what was hidden.
    ``cover`` and ``toward`` are the two ways of Eq. 10 in CD-L1, over all stages: from
    the label to the prediction, and back. ``hidden`` is the way from what was hidden to
    the completion, and ``auxiliary`` Eq. 13, or 0 without it. Differentiable in the
    variables.
    """
    camera = observe(partial, eye, Workspace.unit()).camera
    inputs = prepare_input(partial, camera, key, config.model)
    if with_auxiliary:
        # Whatever else the objective of Eq. 13 judges by joins here.
        losses, prediction = test_time_objective(variables, inputs, config)
        auxiliary = losses.objective
    else:
        prediction = predict(variables, inputs, config.model)
        auxiliary = jnp.zeros(())
    label, hidden = jnp.split(wanted, [num_label])
    returned = _way(hidden, prediction.points)
    return jnp.stack([*_both_ways(prediction, label), returned, auxiliary])


def _both_ways(
    prediction: Prediction, label: Float[Array, "M 3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """From the label to every stage and the refined points, and back, in sum."""
    stages = (*prediction.stages[:-1], prediction.points)
    parts = [(label[: len(stage)], stage) for stage in stages]
    cover = sum((_way(part, stage) for part, stage in parts), jnp.zeros(()))
    toward = sum((_way(stage, part) for part, stage in parts), jnp.zeros(()))
    return cover, toward


def _way(start: Float[Array, "A 3"], end: Float[Array, "B 3"]) -> Float[Array, ""]:
    """Mean distance of points to the nearest ones of another cloud, as `chamfer` has
    it in CD-L1."""
    squared, _ = nearest(start, end)
    return jnp.sqrt(jnp.maximum(squared, SQUARED_DISTANCE_FLOOR)).mean()


def _orders(count: int, size: int, seed: int):
    """Rows of batch after batch: every frame once before any comes again."""
    if count < 1:
        raise InputError("recordings", "leave no frame to train on", "record more")
    waiting, epoch = np.zeros(0, int), 0
    while True:
        while len(waiting) < size:
            order = np.random.default_rng((seed, 0, epoch)).permutation(count)
            waiting, epoch = np.concatenate([waiting, order]), epoch + 1
        rows, waiting = waiting[:size], waiting[size:]
        yield rows
