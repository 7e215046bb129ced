"""Presets by name, and changes to them."""

import dataclasses

import pytest

from experiments.settings import resolve
from prism_jax.io.errors import InputError
from prism_jax.training.presets import PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_without_changes_it_is_the_preset(name):
    assert resolve(name) == PRESETS[name]
    assert hash(resolve(name)) == hash(PRESETS[name])


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
            "pretrain.norm=l2",
            "adapt.num_steps=2",
        ],
    )
    assert changed.adapt.num_steps == 2
    assert changed.adapt.step_size == 1.0
    assert isinstance(changed.adapt.step_size, float)
    assert changed.adapt.adapt_norm is False
    assert changed.model.backbone.stage_sizes[-1] == 128
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
        ("adapt.model.margin=1", "no field 'model'"),
        ("=1", "no field ''"),
        ("adapt..seed=1", "no field ''"),
        ("adapt.num_steps=1.5", "not of type int"),
        ("adapt.num_steps=-1", "AdaptConfig.num_steps must be an integer from 0"),
        ("meta.method.branches=()", "branches must be a tuple of 1 to 8"),
        ("meta.method.beta_0=1.5", "beta_0 must be a number from 0 to 1"),
        ("meta.batch_size=0", "batch_size must be an integer from 1"),
        ("meta.average_decay=2.0", "average_decay must be a number from 0 to 1"),
        ("pretrain.batch_size=-8", "batch_size must be an integer from 1"),
        ("pretrain.backbone=()", "backbone must be a tuple of 1 to 8"),
        ("pretrain.backbone.0.num_samples=-1", "num_samples must be an integer"),
        ("pretrain.backbone.1.num_blocks=9", "num_blocks must be an integer"),
        ("num_shapes=-1", "num_shapes must be an integer from 0"),
        ("adapt.step_size=nan", "not a value"),
        ("pretrain.norm=l3", "not one of l2, l1"),
        ("meta.optimiser=adamw", "not one of sgd, adam"),
        ("meta.method.weight_rule=own", "not one of auxiliary, meta"),
        ("meta.method.branches=('align', 'colour')", "'normal', 'denoise', 'align'"),
        ("meta.method.branches=('align', 1)", "'normal', 'denoise', 'align'"),
        ("adapt.num_steps=True", "not of type int"),
        ("adapt.num_steps=three", "not a value"),
        ("adapt.num_steps=__import__('os')", "not a value"),
        ("adapt.num_steps=", "not a value"),
        ("adapt.adapt_norm=1", "not of type bool"),
        ("adapt.step_size='1'", "not of type float"),
        ("model.backbone.up_factors=2", "not of type tuple"),
        ("model.backbone.up_factors=(1, 2.5)", "not of type tuple"),
        ("model.backbone.patch_points=(32,)", "not of type tuple"),
        ("pretrain.backbone.1.num_blocks=all", "not a value"),
        ("pretrain.backbone.1.num_blocks='all'", "not of type int | None"),
        ("adapt=1", "not of type AdaptConfig"),
        ("adapt.num_steps.more=1", "'more'"),
        ("pretrain.backbone.5.num_samples=1", "'5'"),
        ("pretrain.backbone.first.num_samples=1", "'first'"),
        ("pretrain.backbone.0=1", "not of type PhaseConfig"),
        ("model.backbone.up_factors.0=3.5", "not of type int"),
    ],
)
def test_a_change_that_cannot_be_made(change, fault):
    with pytest.raises(InputError, match=fault) as caught:
        resolve("tiny", [change])
    assert str(caught.value).startswith(change[:5])


def test_an_item_of_a_tuple_can_be_changed():
    changed = resolve("tiny", ["model.backbone.up_factors.1=3"])
    assert changed.model.backbone.up_factors == (1, 3)


def test_an_unknown_preset():
    with pytest.raises(InputError, match="huge: no such preset; use one of tiny"):
        resolve("huge")
