"""The order of the legs, around legs that only count."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.presets import resolve
from prism_jax.training import stages
from prism_jax.training.leg import Leg, Source, TrainState

PRESET = resolve("tiny", ["pretrain.backbone.0.num_samples=32"])


@pytest.fixture
def source(examples, validation_examples):
    return Source(examples, validation_examples, 64, 1.4, 0, 16)


@pytest.fixture(autouse=True)
def begun(monkeypatch):
    """Legs in the order in which they were made, with the variables they began with."""
    made = []

    def leg(name, variables, num_samples):
        made.append((name, jax.tree.map(float, variables)))

        def step(state, batch):
            variables = {**state.variables, name: state.variables.get(name, 0.0) + 1.0}
            return TrainState(state.step + 1, variables, ()), jnp.ones(1)

        def validate(variables, batch):
            return jnp.full((len(batch.eye), 1), jnp.abs(variables[name] - 2.0))

        start = TrainState(jnp.int32(0), {**variables, name: jnp.float32(0)}, ())
        return Leg(
            name, num_samples, PRESET.pretrain.batch_size, 128, start, step, validate
        )

    monkeypatch.setattr(stages, "init_backbone", lambda key, config: {})
    monkeypatch.setattr(
        stages,
        "init_auxiliary",
        lambda key, variables, model: {**variables, "initialised": jnp.float32(1)},
    )
    monkeypatch.setattr(
        stages,
        "backbone_leg",
        lambda v, model, phase, config: leg(phase.name, v, phase.num_samples),
    )
    monkeypatch.setattr(
        stages,
        "auxiliary_leg",
        lambda v, adapt, config, seed: leg("auxiliary", v, config.auxiliary_samples),
    )
    return made


def test_each_leg_begins_with_the_best_of_the_one_before(begun, source, tmp_path):
    """Which was after two steps, by a validation that comes every second."""
    variables = stages.pretrain(PRESET, source, tmp_path, seed=0)
    assert begun == [
        ("seeds", {}),
        ("stages", {"seeds": 2.0}),
        ("auxiliary", {"seeds": 2.0, "stages": 2.0, "initialised": 1.0}),
    ]
    expected = {"seeds": 2, "stages": 2, "auxiliary": 2, "initialised": 1}
    assert {name: float(value) for name, value in variables.items()} == expected


def test_broken_off_it_has_nothing_and_resumed_it_ends_the_same(
    begun, source, tmp_path
):
    expected = stages.pretrain(PRESET, source, tmp_path / "unbroken", seed=0)
    begun.clear()
    assert stages.pretrain(PRESET, source, tmp_path / "run", 0, max_steps=2) is None
    assert [name for name, _ in begun] == ["seeds"]
    begun.clear()
    assert stages.pretrain(PRESET, source, tmp_path / "run", 0, max_steps=6) is None
    assert [name for name, _ in begun] == ["seeds", "stages"]
    resumed = stages.pretrain(PRESET, source, tmp_path / "run", 0)
    assert resumed.keys() == expected.keys()
    assert all(np.array_equal(resumed[name], expected[name]) for name in expected)
