"""The one training loop: steps, validation, checkpoints, resumption."""

import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from prism_jax.data.pipeline import (
    Batch,
    Framing,
    frame_example,
    stack,
    training_batches,
)
from prism_jax.data.source import Source
from prism_jax.models.variables import Variables
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.run import Log

LOG_EVERY = 20
VALIDATION_COMPLETE = 4096


class TrainState(NamedTuple):
    """What a step changes and a checkpoint holds."""

    step: Int[Array, ""]
    variables: Variables
    opt_state: Any


class Leg(NamedTuple):
    """A stretch of training with one loss and one optimiser.

    Attributes:
      name: what the log and the checkpoints call it.
      num_samples: examples seen, repetitions counted.
      batch_size: examples per step.
      num_complete: points of the complete cloud that a batch holds.
      start: the state at step 0.
      step_fn: jitted; returns the next state and the terms of the loss.
      validate_fn: jitted; terms of each example's score, of which the last decides
        what is kept, lower being better.
    """

    name: str
    num_samples: int
    batch_size: int
    num_complete: int
    start: TrainState
    step_fn: Callable[[TrainState, Batch], tuple[TrainState, Float[Array, " L"]]]
    validate_fn: Callable[[Variables, Batch], Float[Array, "B S"]]


class Data(NamedTuple):
    """Where batches come from, and how they are framed."""

    train: Source
    validation: Source
    num_partial: int
    margin: float
    seed: int
    validate_every: int
    num_workers: int = 0
    indices: Any = None

    def framing(self, num_complete: int) -> Framing:
        """Of batches with so many points of the complete cloud."""
        return Framing(self.num_partial, num_complete, self.margin)


def train_leg(
    leg: Leg, data: Data, folder: pathlib.Path, max_steps: int | None = None
) -> tuple[Variables, bool]:
    """Trains a leg to its end, or for ``max_steps`` more steps.

    Goes on from the latest checkpoint in ``folder`` if there is one, with the batches
    that would have come next. Returns the variables that did best on the validation
    examples, and whether the leg is done. The log's ``data_wait`` is the share of the
    time in which the loop waited for batches.
    """
    checkpoints = Checkpoints(folder / leg.name)
    state, reader = checkpoints.restore_latest(leg.start) or (leg.start, None)
    state = _fresh(state)
    step, num_steps = int(state.step), leg.num_samples // leg.batch_size
    last = num_steps if max_steps is None else min(num_steps, step + max_steps)
    batches = training_batches(
        data.train,
        data.framing(leg.num_complete),
        leg.batch_size,
        data.seed,
        data.num_workers,
        indices=data.indices,
    )
    if reader is not None:
        batches.set_state(reader)
    log = Log(folder, leg.name, leg.num_samples, step * leg.batch_size)
    validate_steps = max(1, data.validate_every // leg.batch_size)
    recent = []
    while step < last:
        with log.waiting():
            batch = next(batches)
        state, losses = leg.step_fn(state, batch)
        recent.append(losses)
        step += 1
        log.advance(leg.batch_size)
        at_validation = step % validate_steps == 0 or step == last
        if step % LOG_EVERY == 0 or at_validation:
            mean = _finite_mean(recent, leg.name, step)
            recent.clear()
            log.write(step, losses=mean.tolist())
            log.show(loss=float(mean.sum()), last=float(mean[-1]))
        if at_validation:
            scores = validate(leg, data, state.variables)
            log.write(step, validation=scores.tolist())
            checkpoints.save(step, state, batches.get_state(), float(scores[-1]))
    log.close()
    best = checkpoints.restore_best(state)
    checkpoints.close()
    return (state if best is None else best).variables, step == num_steps


def _fresh(state: TrainState) -> TrainState:
    """The state bound to no device, or the second step would compile anew."""
    return jax.device_put(jax.device_get(state))


def _finite_mean(losses: list[Array], name: str, step: int) -> np.ndarray:
    mean = np.mean(jax.device_get(losses), axis=0)
    if not np.isfinite(mean).all():
        raise FloatingPointError(f"{name}: loss {mean} before step {step}")
    return mean


def validate(leg: Leg, data: Data, variables: Variables) -> np.ndarray:
    """Mean scores over the validation examples, in batches of one size.

    Where the last batch would be short it reaches back, and what was scored before is
    left out.
    """
    count = len(data.validation)
    size = min(leg.batch_size, count)
    framing = data.framing(VALIDATION_COMPLETE)
    scores = []
    for start in range(0, count, size):
        rows = np.arange(size) + min(start, count - size)
        examples = [data.validation[int(row)] for row in rows]
        batch = stack([frame_example(example, framing) for example in examples])
        scores.append(np.asarray(leg.validate_fn(variables, batch))[rows >= start])
    return np.concatenate(scores).mean(0)
