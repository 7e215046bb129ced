"""Stage A from nothing to a whole set of variables."""

import pathlib

import jax

from prism_jax.models.backbone import init_backbone
from prism_jax.models.initial import init_auxiliary
from prism_jax.models.variables import Variables
from prism_jax.presets import Preset
from prism_jax.training.auxiliary import auxiliary_leg
from prism_jax.training.leg import Data, Leg, steps_of, train_leg, validate
from prism_jax.training.pretrain import backbone_leg


def pretrain(
    preset: Preset,
    data: Data,
    folder: pathlib.Path,
    seed: int,
    max_steps: int | None = None,
    tensorboard: bool = False,
    start: Variables | None = None,
) -> Variables | None:
    """Trains the backbone leg by leg, then all that reads it (gap 4).

    Each leg begins with what did best on validation in the leg before, and goes on
    from its own checkpoint where one is found; one without samples is left out, and one
    whose samples do not fill a batch raises InputError before any is trained. The
    first begins with the backbone of ``start``, or a fresh one. What reads it begins
    afresh, but for no auxiliary samples it stays as it is in ``start``. Returns the
    best variables, or None if ``max_steps`` ended a leg early.
    """
    config = preset.pretrain
    legs = [(phase.name, phase.num_samples) for phase in config.backbone]
    for name, num_samples in [*legs, ("auxiliary", config.auxiliary_samples)]:
        if num_samples:
            steps_of(name, num_samples, config.batch_size)
    backbone_key, auxiliary_key = jax.random.split(jax.random.key(seed))
    variables = init_backbone(backbone_key, preset.model.backbone)
    if start is not None:
        variables = {
            kind: {name: start[kind][name] for name in parts}
            for kind, parts in variables.items()
        }
    for phase in config.backbone:
        if not phase.num_samples:
            continue
        leg = backbone_leg(variables, preset.model.backbone, phase, config)
        trained = train_leg(leg, data, folder, max_steps, tensorboard)
        if not trained.done:
            return None
        variables = trained.best
    if start is not None and not config.auxiliary_samples:
        return {kind: {**start[kind], **variables.get(kind, {})} for kind in start}
    fresh = init_auxiliary(auxiliary_key, variables, preset.model)
    if not config.auxiliary_samples:
        return fresh
    leg = auxiliary_leg(fresh, preset.config, config, seed)
    trained = train_leg(leg, data, folder, max_steps, tensorboard)
    return _better_refiner(leg, data, trained.best, fresh) if trained.done else None


def _better_refiner(
    leg: Leg, data: Data, variables: Variables, fresh: Variables
) -> Variables:
    """The trained refiner, or the fresh one if that completes better on validation.

    Eq. 3 compares sparse depth maps, through whose holes the far side shows: nothing
    in it says that points must not leave the surface, so it is checked.
    """
    before, after, _ = validate(leg, data, variables)
    print(f"CD-L2 x1e4: {1e4 * before:.4g} unrefined, {1e4 * after:.4g} refined")
    if after <= before:
        return variables
    print("the refiner is left as it was before training")
    params = {**variables["params"], "refiner": fresh["params"]["refiner"]}
    return {**variables, "params": params}
