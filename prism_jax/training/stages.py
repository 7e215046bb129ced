"""Stage A from nothing to a whole set of variables."""

import pathlib

import jax

from prism_jax.models.backbone import init_backbone
from prism_jax.models.initial import init_auxiliary
from prism_jax.models.variables import Variables
from prism_jax.presets import Preset
from prism_jax.training.auxiliary import auxiliary_leg
from prism_jax.training.leg import Source, train_leg
from prism_jax.training.pretrain import backbone_leg


def pretrain(
    preset: Preset,
    source: Source,
    folder: pathlib.Path,
    seed: int,
    max_steps: int | None = None,
) -> Variables | None:
    """Trains the backbone leg by leg, then all that reads it (gap 4).

    Each leg begins with what did best on validation in the leg before, and goes on
    from its own checkpoint where one is found. Returns the best variables, or None if
    ``max_steps`` ended a leg early.
    """
    backbone_key, auxiliary_key = jax.random.split(jax.random.key(seed))
    variables = init_backbone(backbone_key, preset.model.backbone)
    for phase in preset.pretrain.backbone:
        leg = backbone_leg(variables, preset.model.backbone, phase, preset.pretrain)
        variables, done = train_leg(leg, source, folder, max_steps)
        if not done:
            return None
    variables = init_auxiliary(auxiliary_key, variables, preset.model)
    leg = auxiliary_leg(variables, preset.adapt, preset.pretrain, seed)
    variables, done = train_leg(leg, source, folder, max_steps)
    return variables if done else None
