"""Named configurations, and changes to them from the command line."""

import ast
import dataclasses
from collections.abc import Sequence
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from prism_jax.adaptation.config import AdaptConfig, MetaConfig, PrismConfig
from prism_jax.io.errors import InputError
from prism_jax.models.config import AuxiliaryConfig, BackboneConfig, ModelConfig
from prism_jax.models.ranges import check_ranges
from prism_jax.training.config import MetaTrainConfig, PhaseConfig, PretrainConfig


@dataclasses.dataclass(frozen=True)
class Preset:
    """Everything that a run depends on, apart from its seed.

    Attributes:
      model: the networks.
      adapt: how they adapt to a frame.
      pretrain: how they are trained first.
      meta: how they then learn to adapt.
      num_shapes: procedural shapes that are built for it alone, or 0 for the corpus
        that all share.
    """

    model: ModelConfig
    adapt: AdaptConfig
    pretrain: PretrainConfig
    meta: MetaTrainConfig
    num_shapes: int = 0

    def __post_init__(self):
        check_ranges(self, num_shapes=(0, 10**9))

    @property
    def config(self) -> PrismConfig:
        """What its weights are used with."""
        return PrismConfig(self.model, self.adapt)


_SMALL = BackboneConfig(
    num_points=512,
    patch_points=(256, 64),
    patch_features=((32, 64), (64, 128)),
    global_features=(256, 256),
    patch_neighbors=8,
    features=64,
    attention_features=32,
    attention_ratio=2,
    num_neighbors=(8, 8),
    encoder_rates=(1, 4),
    level_rates=((1, 4), (1, 4)),
    seeds_from_patches=True,
    num_initial=256,
    up_factors=(1, 8),
    use_norm=False,
)

_SMALL_AUXILIARY = AuxiliaryConfig(
    depth_features=(16, 32, 64, 64),
    depth_blocks=1,
    num_tokens=16,
    token_features=64,
    hidden=64,
    max_coordinate=2.0,
)

_PAPER = BackboneConfig(
    seed_times=8,
    num_initial=2048,
    up_factors=(1, 2, 4),
)

_TINY = BackboneConfig(
    num_points=64,
    patch_points=(32, 16),
    patch_features=((8, 16), (16, 16)),
    global_features=(16, 16),
    patch_neighbors=4,
    features=16,
    attention_features=8,
    attention_ratio=2,
    num_neighbors=(4, 4),
    encoder_rates=(1, 2),
    level_rates=((1, 2), (1, 2)),
    num_initial=32,
    up_factors=(1, 2),
)

_TINY_AUXILIARY = AuxiliaryConfig(
    depth_features=(4, 8),
    depth_blocks=1,
    num_tokens=4,
    token_features=8,
    hidden=8,
    denoise_neighbors=4,
)


def _phases(*samples: int) -> tuple[PhaseConfig, ...]:
    """Seeds alone, then the whole decoder."""
    seeds, every = samples
    return (
        PhaseConfig("seeds", seeds, num_blocks=0, final_rate=0.5),
        PhaseConfig("stages", every, num_blocks=None),
    )


_SMALL_ADAPT = AdaptConfig(
    num_steps=1,
    step_size=3e-2,
    clip_norm=1.0,
    normal_stride=4,
)

# It differs from the paper's method: the encoders have no auxiliary loss in the outer
# loop (lambda_aux=0), the loss weights learn from the adapted completion and not from the
# weighted loss itself ("meta"), the inner loop descends exactly what test time descends,
# its step sizes and the auxiliary modules are learned, and the refiner stays.
_SMALL_META = MetaTrainConfig(
    MetaConfig(
        lambda_aux=0.0,
        weight_rule="meta",
        rehearse_depth=True,
        learn_steps=True,
        learn_auxiliary=True,
        learn_refiner=False,
    ),
    num_samples=32_000,
    at_once=8,
    num_complete=2048,
    optimiser="adam",
    learning_rate=1e-4,
    final_rate=0.01,
    warmup_steps=50,
    clip_norm=1.0,
    weight_rate=1e-2,
    step_rate=2e-2,
    auxiliary_rate=3e-3,
    average_decay=0.99,
    validate_every=4_000,
)

_PAPER_PRETRAIN = PretrainConfig(
    _phases(2_000_000, 8_000_000), auxiliary_samples=500_000, num_complete=16_384
)

_PAPER_META = MetaTrainConfig(MetaConfig(remat=True), at_once=4)

# The paper's sizes and samples with what helped `small` on validation.
_PLUS = Preset(
    ModelConfig(
        dataclasses.replace(_PAPER, seeds_from_patches=True),
        AuxiliaryConfig(max_coordinate=2.0),
    ),
    _SMALL_ADAPT,
    _PAPER_PRETRAIN,
    dataclasses.replace(
        _SMALL_META,
        method=dataclasses.replace(_SMALL_META.method, remat=True),
        num_samples=_PAPER_META.num_samples,
        at_once=_PAPER_META.at_once,
        num_complete=_PAPER_META.num_complete,
        validate_every=_PAPER_META.validate_every,
    ),
)

PRESETS = {
    "tiny": Preset(
        ModelConfig(_TINY, _TINY_AUXILIARY, depth_pixels=32, consistency_pixels=16),
        AdaptConfig(normal_neighbors=4),
        PretrainConfig(
            _phases(64, 64),
            auxiliary_samples=64,
            batch_size=8,
            num_complete=128,
            validate_every=32,
        ),
        MetaTrainConfig(
            num_samples=128, batch_size=8, num_complete=128, validate_every=32
        ),
        num_shapes=64,
    ),
    "small": Preset(
        ModelConfig(_SMALL, _SMALL_AUXILIARY, consistency_pixels=32),
        _SMALL_ADAPT,
        PretrainConfig(_phases(200_000, 768_000), auxiliary_samples=20_000),
        _SMALL_META,
    ),
    "paper": Preset(ModelConfig(_PAPER), AdaptConfig(), _PAPER_PRETRAIN, _PAPER_META),
    "plus": _PLUS,
}


def resolve(name: str, changes: Sequence[str] = ()) -> Preset:
    """A preset by name with ``path.to.field=value`` changes applied.

    An unknown preset or field, or a value of another type, raises `InputError`.
    """
    if name not in PRESETS:
        known = ", ".join(PRESETS)
        raise InputError(name, "no such preset", f"use one of {known}")
    return changed(PRESETS[name], changes)


def changed(config: Any, changes: Sequence[str]) -> Any:
    """A configuration with ``path.to.field=value`` changes applied, as in `resolve`."""
    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise InputError(change, "not a change", "write path.to.field=value")
        config = _replaced(config, type(config), path.split("."), text, change)
    return config


def _replaced(config: Any, kind: Any, path: list[str], text: str, change: str) -> Any:
    if not path:
        return _value(kind, text, change)
    name, *rest = path
    parts = _parts(config, kind)
    if name not in parts:
        remedy = f"use one of {', '.join(parts)}" if parts else "leave it out"
        raise InputError(change, f"no field {name!r}", remedy)
    value = _replaced(*parts[name], rest, text, change)
    if isinstance(config, tuple):
        index = int(name)
        return (*config[:index], value, *config[index + 1 :])
    try:
        return dataclasses.replace(config, **{name: value})
    except ValueError as error:
        raise InputError(change, str(error), "give a value in its range") from None


def _parts(config: Any, kind: Any) -> dict[str, tuple[Any, Any]]:
    """Named parts of a dataclass, numbered ones of a tuple, none of a plain value; each
    with the type that is asked of it."""
    if isinstance(config, tuple):
        items = zip(config, _items(kind, len(config)), strict=True)
        return {str(index): item for index, item in enumerate(items)}
    if not dataclasses.is_dataclass(config):
        return {}
    kinds = get_type_hints(type(config))
    return {name: (getattr(config, name), kind) for name, kind in kinds.items()}


def _value(kind: Any, text: str, change: str) -> Any:
    """The text as a value of that type: words as they are, the rest as in Python."""
    word = get_origin(kind) is Literal
    value = text if word or kind is str else _literal(text, change)
    if kind is float and type(value) is int:
        value = float(value)
    if not _fits(value, kind):
        name = kind.__name__ if isinstance(kind, type) else str(kind)
        choice = f"one of {', '.join(get_args(kind))}" if word else f"of type {name}"
        raise InputError(change, f"not {choice}", "give a value that is")
    return value


def _literal(text: str, change: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        raise InputError(change, "not a value", "write a Python literal") from None


def _fits(value: Any, kind: Any) -> bool:
    options = get_args(kind)
    if get_origin(kind) is Literal:
        return value in options
    if get_origin(kind) is UnionType:
        return any(_fits(value, option) for option in options)
    if get_origin(kind) is not tuple:
        return type(value) is kind
    if type(value) is not tuple:
        return False
    items = _items(kind, len(value))
    return len(value) == len(items) and all(map(_fits, value, items))


def _items(kind: Any, count: int) -> tuple[Any, ...]:
    """The types of a tuple's items: of so many, where the number is open."""
    items = get_args(kind)
    return items[:1] * count if items[-1] is Ellipsis else items
