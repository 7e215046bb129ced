"""The one training loop: steps, validation, checkpoints, resumption."""

import hashlib
import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from prism_jax.data import pipeline
from prism_jax.data.pipeline import Batch, Framing
from prism_jax.data.source import Source
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables
from prism_jax.preprocessing.observation import Heading
from prism_jax.training import parallel
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.run import Log

LOG_EVERY = 20
SAVE_SECONDS = 120.0
"""What a killed training may lose, and the steps up to the next log line."""
VALIDATION_COMPLETE = 4096


class TrainState(NamedTuple):
    """What a step changes and a checkpoint holds."""

    step: Int[Array, ""]  # how many were made
    variables: Variables  # what the next step starts from
    opt_state: Any  # the optimiser's
    # Moving average of the variables, or None if none is kept.
    average: Variables | None = None

    @property
    def kept(self) -> Variables:
        """What is validated, and released: the average where there is one."""
        return self.variables if self.average is None else self.average


def averaged(
    average: Variables | None, variables: Variables, kept: float | Float[Array, ""]
) -> Variables | None:
    """The moving average after a step, if there is one, of which this share is kept."""
    if average is None:
        return None
    return jax.tree.map(lambda a, v: kept * a + (1 - kept) * v, average, variables)


class Phase(NamedTuple):
    """A stretch of training with one loss and one optimiser."""

    name: str  # what the log and the checkpoints call it
    num_samples: int  # examples seen, repetitions counted
    batch_size: int  # examples per step
    num_complete: int  # points of the complete cloud that a batch holds
    start: TrainState  # the state at step 0
    # Jitted; returns the next state and the terms of the loss.
    step_fn: Callable[[TrainState, Batch], tuple[TrainState, Float[Array, " L"]]]
    # Jitted; terms of each example's score, or of its batch's; the last decides what is
    # kept, lower being better.
    validate_fn: Callable[[Variables, Batch], Float[Array, "B S"]]
    # What the two return, by name, for the log.
    terms: tuple[str, ...]
    scores: tuple[str, ...]
    # Samples without a better validation after which it ends; 0 for never.
    patience: int = 0


class Data(NamedTuple):
    """Where batches come from, and how they are framed."""

    train: Source
    validation: Mapping[str, Source]  # sets that count alike, however large they are
    num_partial: int
    margin: float
    seed: int
    validate_every: int
    num_workers: int = 0
    heading: Heading = "given"

    def framing(self, num_complete: int) -> Framing:
        """Of batches with so many points of the complete cloud."""
        return Framing(self.num_partial, num_complete, self.margin, self.heading)


class Trained(NamedTuple):
    """What a training leaves: the variables that did best on the validation sets, the
    last state, and whether the phase is done."""

    best: Variables
    last: TrainState
    done: bool


def train_phase(
    phase: Phase, data: Data, folder: pathlib.Path, max_steps: int | None = None
) -> Trained:
    """Trains a phase to its end, to step ``max_steps``, or until it gains nothing more
    (``phase.patience``).

    Goes on from the latest checkpoint in ``folder`` if there is one, with the batches
    that would have come next (`order_seed`). One step is always queued behind the one
    that runs, no more, so that the bar is where the work is. A batch lies over all
    devices. A loss or a variable that is not a number raises FloatingPointError. The
    state is saved at every validation, every `SAVE_SECONDS`, and where ``max_steps``
    ends the phase; only what is validated can be the best.
    """
    parallel.check_batch(phase.batch_size)
    checkpoints = Checkpoints(folder / phase.name)
    start = parallel.replicate(phase.start)
    state = parallel.replicate(checkpoints.restore(start) or start)
    num_steps = steps_of(phase.name, phase.num_samples, phase.batch_size)
    step = int(state.step)
    validate_steps = max(1, data.validate_every // phase.batch_size)
    stale = _is_stale(phase, checkpoints, step - step % validate_steps)
    last = num_steps if max_steps is None else min(num_steps, max_steps)
    framing, seed = data.framing(phase.num_complete), order_seed(data.seed, phase.name)
    order = phase.batch_size, seed, data.num_workers, step
    batches = pipeline.training_batches(data.train, framing, *order)
    log = Log(folder, phase.name, phase.num_samples, step, phase.batch_size)
    recent, before = [], None
    saved = time.monotonic()
    while step < last and not stale:
        batch = parallel.share(next(batches))
        state, losses = phase.step_fn(state, batch)
        recent.append(losses)
        step += 1
        jax.block_until_ready(before)
        before = losses
        log.advance(phase.batch_size)
        at_validation = step % validate_steps == 0 or step == num_steps
        if step % LOG_EVERY == 0 or at_validation or step == last:
            mean = np.mean(jax.device_get(recent), axis=0)
            if not np.isfinite(mean).all():
                fault = f"{phase.name}: loss {mean} before step {step}"
                raise FloatingPointError(fault)
            recent.clear()
            log.write(step, losses=dict(zip(phase.terms, mean.tolist(), strict=True)))
        is_due = step % LOG_EVERY == 0 and time.monotonic() - saved > SAVE_SECONDS
        if not (at_validation or is_due or step == last):
            continue
        # A step may turn a finite loss into variables that are not numbers. Infinities
        # are the logits of branches that do not count.
        numbers = jax.tree.leaves(jax.device_get(state.variables))
        if any(np.isnan(leaf).any() for leaf in numbers):
            fault = f"{phase.name}: variables are not finite at step {step}"
            raise FloatingPointError(fault)
        score = None
        if at_validation:
            scores = validate(phase, data, state.kept)
            named = {
                f"{part}/{name}": float(value)
                for part, values in scores.items()
                for name, value in zip(phase.scores, values, strict=True)
            }
            log.write(step, validation=named)
            score = float(np.mean([each[-1] for each in scores.values()]))
        checkpoints.save(step, state, score)
        stale = at_validation and _is_stale(phase, checkpoints, step)
        saved = time.monotonic()
    log.close()
    best = checkpoints.restore(state, best=True)
    checkpoints.close()
    return Trained((best or state).kept, state, stale or step >= num_steps)


def _is_stale(phase: Phase, checkpoints: Checkpoints, step: int) -> bool:
    """Whether a validation at this step was the last that it takes."""
    best = checkpoints.best_step()
    if not phase.patience or best is None:
        return False
    return (step - best) * phase.batch_size >= phase.patience


def order_seed(seed: int, name: str) -> int:
    """What a phase's batches are shuffled and mirrored by: its name, so that no phase
    repeats another's, and no computed number, which another machine would round
    differently."""
    digest = hashlib.sha256(f"{seed} {name}".encode()).digest()
    return int.from_bytes(digest[:4]) % 2**31


def steps_of(name: str, num_samples: int, batch_size: int) -> int:
    """Of a phase; InputError if its samples do not fill one batch."""
    if num_samples < batch_size or batch_size < 1:
        fault = f"{num_samples} samples do not fill a batch of {batch_size}"
        raise InputError(name, fault, "set more num_samples, or a smaller batch_size")
    return num_samples // batch_size


def validate(
    phase: Phase, data: Data, variables: Variables
) -> dict[str, Float[np.ndarray, " S"]]:
    """Mean scores over each validation set, in batches of the training's size. The last
    is filled up from the first example; what is scored twice counts once."""
    size, framing = phase.batch_size, data.framing(VALIDATION_COMPLETE)
    means = {}
    for name, source in data.validation.items():
        count, scores = len(source), []
        for start in range(0, count, size):
            rows = (np.arange(start, start + size) % count).tolist()
            framed = [pipeline.frame_example(source[row], framing) for row in rows]
            batch = pipeline.stack(framed)
            scored = phase.validate_fn(variables, parallel.share(batch))
            scores.append(np.asarray(scored)[: count - start])
        means[name] = np.concatenate(scores).mean(0)
    return means
