"""Presets by name, and changes to them."""

import dataclasses

import pytest

from experiments.presets import PRESETS
from experiments.settings import resolve
from prism_jax.io.errors import InputError


def test_changes_reach_every_level_and_leave_the_preset_alone():
    changed = resolve(
        "tiny",
        [
            "adapt.num_steps=1",
            "adapt.step_size=1",
            "adapt.adapt_norm=False",
            "model.backbone.up_factors=(1, 4)",
            "model.auxiliary.max_offset=0.2",
            "pretrain.backbone.1.num_samples=8",
            "pretrain.backbone.0.name=first",
            "pretrain.backbone.0.num_blocks=None",
            "pretrain.backbone.1.num_blocks=1",
            "model.backbone.up_factors.1=3",
            "pretrain.norm=l2",
            "adapt.num_steps=2",
        ],
    )
    assert changed.adapt.num_steps == 2
    assert changed.adapt.step_size == 1.0
    assert isinstance(changed.adapt.step_size, float)
    assert changed.adapt.adapt_norm is False
    assert changed.model.backbone.up_factors == (1, 3)
    assert changed.model.auxiliary.max_offset == 0.2
    assert [phase.num_samples for phase in changed.pretrain.backbone] == [64, 8]
    assert changed.pretrain.backbone[0].name == "first"
    assert [phase.num_blocks for phase in changed.pretrain.backbone] == [None, 1]
    assert changed.pretrain.norm == "l2"
    assert resolve("tiny") == PRESETS["tiny"]
    before = PRESETS["tiny"].pretrain
    same = dataclasses.replace(changed.pretrain, backbone=before.backbone, norm="l1")
    assert same == before


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("adapt.num_steps", "not a setting"),
        ("adapt.steps=1", "no field 'steps'"),
        ("adapt..seed=1", "no field ''"),
        ("adapt.num_steps=1.5", "not of type int"),
        ("meta.method.branches=()", "branches must be a tuple of 1 to 8"),
        ("pretrain.batch_size=-8", "batch_size must be an integer from 1"),
        ("pretrain.backbone.1.num_blocks=9", "num_blocks must be an integer"),
        ("pretrain.norm=l3", "not one of l2, l1"),
        ("meta.method.branches=('align', 'colour')", "'normal', 'denoise', 'align'"),
        ("adapt.num_steps=__import__('os')", "not a value"),
        ("adapt.adapt_norm=1", "not of type bool"),
        ("model.backbone.up_factors=2", "not of type tuple"),
        ("pretrain.backbone.1.num_blocks='all'", "not of type int | None"),
        ("adapt=1", "not of type AdaptConfig"),
        ("adapt.num_steps.more=1", "'more'"),
    ],
)
def test_a_change_that_cannot_be_made(change, fault):
    with pytest.raises(InputError, match=fault) as caught:
        resolve("tiny", [change])
    assert str(caught.value).startswith(change[:5])


def test_an_unknown_preset():
    with pytest.raises(InputError, match="huge: no such preset; use one of tiny"):
        resolve("huge")
