"""The order of the phases, around phases that know their own number alone."""

import pathlib

import numpy as np
import pytest

from experiments import pretraining
from experiments.settings import resolve
from prism_jax.io.errors import InputError
from prism_jax.training.phase import Data, Phase, Trained, TrainState, steps_of

SEEDS, AUXILIARY = "pretrain.backbone.0.num_samples", "pretrain.auxiliary_samples"
FRESH = {"refiner": 0.0, "integrator": 0.0}


@pytest.fixture
def pretrain(monkeypatch):
    """``pretrain(*changes of tiny, ...)``, which notes with what each phase begins.

    The best of a phase has 2 in the place of its name, the last state 9. CD-L2 is 3
    without the refiner, and with it `pretrain.refined`.
    """

    def phase(name, variables, num_samples, training):
        pretrain.begun.append((name, dict(variables["params"])))
        start, size = TrainState(np.int32(0), variables, ()), training.batch_size
        return Phase(name, num_samples, size, 128, start, None, None, (), ())

    def train_phase(phase, data, folder, max_steps):
        def after(value):
            return {**before, "params": {**before["params"], phase.name: value}}

        before = phase.start.variables
        steps = steps_of(phase.name, phase.num_samples, phase.batch_size)
        last = TrainState(np.int32(steps), after(9.0), ())
        return Trained(after(2.0), last, steps <= (max_steps or steps))

    def pretrain(*changes, **settings):
        preset, data = resolve("tiny", changes), Data(None, None, 64, 1.4, 0, 16)
        return pretraining.pretrain(
            preset.config, preset.pretrain, data, pathlib.Path(), 0, **settings
        )

    stand_ins = {
        "init_backbone": lambda key, model: {"params": {"encoder": 0.0}},
        "init_auxiliary": lambda key, variables, model: {
            "params": {**variables["params"], **FRESH}
        },
        "backbone_phase": lambda variables, model, each, training: phase(
            each.name, variables, each.num_samples, training
        ),
        "auxiliary_phase": lambda variables, config, training, seed: phase(
            "refiner", variables, training.auxiliary_samples, training
        ),
        "train_phase": train_phase,
        "validate": lambda *_: {"a": np.array([3.0, pretrain.refined, 0.0])},
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(pretraining, name, stand_in)
    pretrain.begun, pretrain.refined = [], 2.9
    return pretrain


def test_each_phase_begins_with_the_best_of_the_one_before(pretrain):
    variables = pretrain()
    backbone = {"encoder": 0.0, "seeds": 2.0, "stages": 2.0}
    assert pretrain.begun == [
        ("seeds", {"encoder": 0.0}),
        ("stages", {"encoder": 0.0, "seeds": 2.0}),
        ("refiner", {**backbone, **FRESH}),
    ]
    assert variables["params"] == {**backbone, **FRESH, "refiner": 2.0}


def test_a_refiner_that_makes_it_worse_is_not_kept(pretrain):
    pretrain.refined = 3.1
    params = pretrain()["params"]
    assert (params["refiner"], params["stages"]) == (0.0, 2.0)


def test_from_other_weights_and_without_a_phase(pretrain):
    """The backbone is theirs, what reads it is not; or is, if it is not trained."""
    params, weighting = {"encoder": 7.0, "refiner": 8.0}, {"logits": 1.0}
    start = {"params": params, "weighting": weighting}
    pretrain(f"{SEEDS}=0", start=start)
    assert pretrain.begun == [
        ("stages", {"encoder": 7.0}),
        ("refiner", {"encoder": 7.0, "stages": 2.0, **FRESH}),
    ]
    found = pretrain(f"{SEEDS}=0", f"{AUXILIARY}=0", start=start)
    assert found == {"params": {**params, "stages": 2.0}, "weighting": weighting}
    found = pretrain(f"{AUXILIARY}=0")
    assert found["params"] == {"encoder": 0.0, "seeds": 2.0, "stages": 2.0, **FRESH}


def test_broken_off_it_has_nothing(pretrain):
    """The seeds take four steps, the stages eight."""
    for max_steps, names in ((2, ["seeds"]), (6, ["seeds", "stages"])):
        pretrain.begun.clear()
        assert pretrain(f"{SEEDS}=32", max_steps=max_steps) is None
        assert [name for name, _ in pretrain.begun] == names


def test_a_phase_that_fills_no_batch_is_refused_before_the_first(pretrain):
    with pytest.raises(InputError, match="auxiliary: 7 samples do not fill"):
        pretrain(f"{AUXILIARY}=7")
    assert not pretrain.begun
