"""Stage A of the paper, from nothing to a whole set of variables."""

import pathlib

import jax
import numpy as np

from prism_jax.adaptation.config import PrismConfig
from prism_jax.models.backbone import init_backbone
from prism_jax.models.initial import init_auxiliary
from prism_jax.models.variables import Variables
from prism_jax.training.auxiliary import auxiliary_phase
from prism_jax.training.config import PretrainConfig
from prism_jax.training.phase import Data, Phase, steps_of, train_phase, validate
from prism_jax.training.supervised import backbone_phase


def pretrain(
    config: PrismConfig,
    training: PretrainConfig,
    data: Data,
    folder: pathlib.Path,
    seed: int,
    max_steps: int | None = None,
    start: Variables | None = None,
) -> Variables | None:
    """Trains the backbone phase by phase, then all that reads it (gap 4).

    Each phase begins with what did best on validation in the phase before, and goes on
    from its own checkpoint where one is found. One without samples is left out; samples
    that do not fill a batch raise InputError before any training. The first begins with
    the backbone of ``start``, or a fresh one. What reads it begins afresh, unless there
    are no auxiliary samples. Returns None if ``max_steps`` ended a phase early.
    """
    samples = {each.name: each.num_samples for each in training.backbone}
    samples["auxiliary"] = training.auxiliary_samples
    for name, num_samples in samples.items():
        if num_samples:
            steps_of(name, num_samples, training.batch_size)
    backbone_key, auxiliary_key = jax.random.split(jax.random.key(seed))
    variables = init_backbone(backbone_key, config.model.backbone)
    if start is not None:
        variables = {
            kind: {name: start[kind][name] for name in parts}
            for kind, parts in variables.items()
        }
    for each in training.backbone:
        if not each.num_samples:
            continue
        phase = backbone_phase(variables, config.model.backbone, each, training)
        trained = train_phase(phase, data, folder, max_steps)
        if not trained.done:
            return None
        variables = trained.best
    if start is not None and not training.auxiliary_samples:
        return {kind: {**start[kind], **variables.get(kind, {})} for kind in start}
    fresh = init_auxiliary(auxiliary_key, variables, config.model)
    if not training.auxiliary_samples:
        return fresh
    phase = auxiliary_phase(fresh, config, training, seed)
    trained = train_phase(phase, data, folder, max_steps)
    return _better_refiner(phase, data, trained.best, fresh) if trained.done else None


def _better_refiner(
    phase: Phase, data: Data, variables: Variables, fresh: Variables
) -> Variables:
    """The trained refiner, or the fresh one if that completes better on validation. Eq.
    3 compares sparse depth maps, through whose holes the far side shows: nothing in it
    says that points must not leave the surface, so it is checked."""
    scores = validate(phase, data, variables).values()
    before, after, _ = np.mean([*scores], axis=0)
    print(f"CD-L2 x1e4: {1e4 * before:.4g} unrefined, {1e4 * after:.4g} refined")
    if after <= before:
        return variables
    print("kept the untrained refiner, which scores better")
    params = {**variables["params"], "refiner": fresh["params"]["refiner"]}
    return {**variables, "params": params}
