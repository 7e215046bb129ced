"""One leg of a pretraining: steps, validation, checkpoints, resumption."""

import pathlib

import jax
import numpy as np

from prism_jax.data.corpus import Examples
from prism_jax.models.backbone import Variables
from prism_jax.models.config import BackboneConfig
from prism_jax.training.batches import TrainingOrder, make_batch
from prism_jax.training.checkpoints import Checkpoints
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.pretrain import (
    backbone_optimiser,
    make_backbone_step,
    make_validation,
    start_phase,
)
from prism_jax.training.run import Log

LOG_EVERY = 20


def train_backbone_phase(
    variables: Variables,
    model: BackboneConfig,
    phase: PhaseConfig,
    config: PretrainConfig,
    margin: float,
    data: tuple[Examples, Examples],
    folder: pathlib.Path,
    seed: int,
    max_steps: int | None = None,
) -> tuple[Variables, bool]:
    """Trains one phase to its end, or for ``max_steps`` more steps.

    Goes on from the latest checkpoint in ``folder`` if there is one. Returns the
    variables that did best on the validation examples, and whether the phase is done.
    """
    optimiser = backbone_optimiser(phase, config)
    step_fn = make_backbone_step(model, phase, config, optimiser)
    validate_fn = make_validation(model)
    train, validation = data
    checkpoints = Checkpoints(folder / phase.name)
    state = start_phase(variables, optimiser)
    state = checkpoints.restore_latest(state) or state
    step, num_steps = int(state.step), phase.num_samples // config.batch_size
    last = num_steps if max_steps is None else min(num_steps, step + max_steps)
    order = TrainingOrder(len(train.partial), config.batch_size, seed)
    log = Log(folder, phase.name, phase.num_samples, step * config.batch_size)
    validate_steps = max(1, config.validate_every // config.batch_size)
    recent = []
    while step < last:
        rows, mirrored = order.rows(step)
        batch = make_batch(
            train, rows, model.num_points, config.num_complete, margin, mirrored
        )
        state, losses = step_fn(state, batch)
        recent.append(losses)
        step += 1
        shown = {}
        if step % LOG_EVERY == 0:
            mean = np.mean(jax.device_get(recent), axis=0)
            recent.clear()
            if not np.isfinite(mean).all():
                raise FloatingPointError(f"{phase.name}: loss {mean} at step {step}")
            shown = {"loss": mean.sum(), "last": mean[-1]}
            log.write(step, losses=mean.tolist())
        log.advance(config.batch_size, **shown)
        if step % validate_steps == 0 or step == last:
            scores = validation_scores(
                validate_fn, state.variables, validation, model, config, margin
            )
            log.write(step, validation_cd_l2=scores.tolist())
            trained = -1 if phase.num_blocks is None else phase.num_blocks
            checkpoints.save(step, state, float(scores[trained]))
    log.close()
    best = checkpoints.restore_best(state)
    checkpoints.close()
    return (state if best is None else best).variables, step == num_steps


def validation_scores(
    validate_fn, variables, examples, model, config, margin
) -> np.ndarray:
    """Mean CD-L2 of every stage over the validation examples."""
    scores = []
    for start in range(0, config.num_validation, config.batch_size):
        stop = min(start + config.batch_size, len(examples.partial))
        rows = np.arange(stop - config.batch_size, stop)
        batch = make_batch(examples, rows, model.num_points, 4096, margin)
        scores.append(np.asarray(validate_fn(variables, batch)))
    return np.concatenate(scores).mean(0)
