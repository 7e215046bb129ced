"""The order of the phases, around phases that only count."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.settings import resolve
from prism_jax.io.errors import InputError
from prism_jax.training import pretraining
from prism_jax.training.phase import Data, Phase, TrainState

PRESET = resolve("tiny", ["pretrain.backbone.0.num_samples=32"])
BATCH = PRESET.pretrain.batch_size


def pretrained(preset, *arguments, **settings):
    return pretraining.pretrain(preset.config, preset.pretrain, *arguments, **settings)


@pytest.fixture
def data(examples, validation_examples):
    """Validation comes every second step."""
    return Data(examples, validation_examples, 64, 1.4, 0, 2 * BATCH)


def counting_phase(name, variables, num_samples, scores_fn, num_scores):
    """Adds one to its own parameter at every step."""

    def step(state, batch):
        params = state.variables["params"]
        params = {**params, name: params[name] + 1.0}
        return TrainState(state.step + 1, {"params": params}, ()), jnp.ones(1)

    def validate(variables, batch):
        scores = jnp.stack(scores_fn(variables["params"]))
        return jnp.broadcast_to(scores, (len(batch.eye), len(scores)))

    params = {name: jnp.float32(0), **variables["params"]}
    start = TrainState(jnp.int32(0), {"params": params}, ())
    names = ("loss",), ("unrefined", "refined", "last")[-num_scores:]
    return Phase(name, num_samples, BATCH, 128, start, step, validate, *names)


@pytest.fixture(autouse=True)
def begun(monkeypatch):
    """Phases in the order in which they were made, with the parameters they began with.

    Those of the backbone do best after two steps, the refiner's after four.
    """
    made = []

    def backbone_phase(variables, model, phase, training):
        made.append((phase.name, jax.tree.map(float, variables["params"])))

        def scores(params):
            return [jnp.abs(params[phase.name] - 2.0)]

        return counting_phase(phase.name, variables, phase.num_samples, scores, 1)

    def auxiliary_phase(variables, config, training, seed):
        made.append(("refiner", jax.tree.map(float, variables["params"])))

        def scores(params):
            return [jnp.float32(3), params["harm"], jnp.abs(params["refiner"] - 4.0)]

        return counting_phase(
            "refiner", variables, training.auxiliary_samples, scores, 3
        )

    def init_auxiliary(key, variables, model):
        fresh = {"refiner": jnp.float32(0), "harm": jnp.float32(0)}
        return {"params": {**variables["params"], **fresh}}

    monkeypatch.setattr(
        pretraining, "init_backbone", lambda key, config: {"params": {}}
    )
    monkeypatch.setattr(pretraining, "init_auxiliary", init_auxiliary)
    monkeypatch.setattr(pretraining, "backbone_phase", backbone_phase)
    monkeypatch.setattr(pretraining, "auxiliary_phase", auxiliary_phase)
    return made


def test_each_phase_begins_with_the_best_of_the_one_before(begun, data, tmp_path):
    variables = pretrained(PRESET, data, tmp_path, seed=0)
    fresh = {"refiner": 0.0, "harm": 0.0}
    assert begun == [
        ("seeds", {}),
        ("stages", {"seeds": 2.0}),
        ("refiner", {"seeds": 2.0, "stages": 2.0, **fresh}),
    ]
    found = jax.tree.map(float, variables["params"])
    assert found == {"seeds": 2.0, "stages": 2.0, "refiner": 4.0, "harm": 0.0}


def test_from_other_weights_and_without_a_phase(begun, data, tmp_path, monkeypatch):
    """The backbone is theirs, what reads it is not."""
    preset = resolve("tiny", ["pretrain.backbone.0.num_samples=0"])
    fresh = {"params": {"encoder": jnp.float32(0)}}
    monkeypatch.setattr(pretraining, "init_backbone", lambda key, config: fresh)
    start = {"params": {"encoder": jnp.float32(7), "refiner": jnp.float32(9)}}
    pretrained(preset, data, tmp_path, seed=0, start=start)
    assert begun == [
        ("stages", {"encoder": 7.0}),
        ("refiner", {"encoder": 7.0, "stages": 2.0, "refiner": 0.0, "harm": 0.0}),
    ]


def test_without_samples_what_reads_the_backbone_stays_fresh(begun, data, tmp_path):
    preset = resolve("tiny", ["pretrain.auxiliary_samples=0"])
    variables = pretrained(preset, data, tmp_path, seed=0)
    assert [name for name, _ in begun] == ["seeds", "stages"]
    assert variables["params"]["refiner"] == 0.0
    assert variables["params"]["stages"] == 2.0


def test_or_as_it_is_in_the_weights_that_it_goes_on_from(begun, data, tmp_path):
    phases = ["pretrain.auxiliary_samples=0", "pretrain.backbone.0.num_samples=0"]
    fresh = {"params": {"encoder": 7.0}}
    start = {"params": {"encoder": 7.0, "refiner": 9.0}, "weighting": {"logits": 1.0}}
    start, fresh = jax.tree.map(jnp.float32, (start, fresh))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretraining, "init_backbone", lambda key, config: fresh)
        variables = pretrained(
            resolve("tiny", phases), data, tmp_path, seed=0, start=start
        )
    found = {"encoder": 7.0, "stages": 2.0, "refiner": 9.0}
    assert jax.tree.map(float, variables["params"]) == found
    assert variables["weighting"] == start["weighting"]


def test_a_phase_that_fills_no_batch_is_refused_before_the_first(begun, data, tmp_path):
    preset = resolve("tiny", [f"pretrain.auxiliary_samples={BATCH - 1}"])
    with pytest.raises(InputError, match=f"auxiliary: {BATCH - 1} samples do not fill"):
        pretrained(preset, data, tmp_path, seed=0)
    assert not begun


@pytest.mark.parametrize(("refined", "kept"), [(2.9, 4.0), (3.0, 4.0), (3.1, 0.0)])
def test_a_refiner_that_makes_it_worse_is_not_kept(
    monkeypatch, data, tmp_path, refined, kept
):
    """The distance is 3 without it."""
    fresh = {"refiner": jnp.float32(0), "harm": jnp.float32(refined)}
    monkeypatch.setattr(
        pretraining,
        "init_auxiliary",
        lambda key, variables, model: {"params": {**variables["params"], **fresh}},
    )
    variables = pretrained(PRESET, data, tmp_path, seed=0)
    assert float(variables["params"]["refiner"]) == kept
    assert float(variables["params"]["stages"]) == 2.0


def test_broken_off_it_has_nothing_and_resumed_it_ends_the_same(begun, data, tmp_path):
    expected = pretrained(PRESET, data, tmp_path / "unbroken", seed=0)
    begun.clear()
    assert pretrained(PRESET, data, tmp_path / "run", 0, max_steps=2) is None
    assert [name for name, _ in begun] == ["seeds"]
    begun.clear()
    assert pretrained(PRESET, data, tmp_path / "run", 0, max_steps=6) is None
    assert [name for name, _ in begun] == ["seeds", "stages"]
    resumed = pretrained(PRESET, data, tmp_path / "run", 0)
    assert resumed["params"].keys() == expected["params"].keys()
    for name, value in expected["params"].items():
        assert np.array_equal(resumed["params"][name], value)
