"""The phase of meta-training, around a stand-in for the network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.presets import PRESETS
from prism_jax.adaptation.config import MetaConfig, PrismConfig
from prism_jax.geometry.visibility import SURFACE, nothing_known
from prism_jax.io.errors import InputError
from prism_jax.models.variables import ENCODERS
from prism_jax.training import meta, parallel
from prism_jax.training.config import MetaTrainConfig
from prism_jax.training.meta import TERMS, check_meta, meta_phase
from tests import stand_in_networks
from tests.trees import assert_close, bitwise

BATCH = 4
EVERYTHING = MetaConfig(
    weight_rule="meta", rehearse_depth=True, learn_steps=True, learn_auxiliary=True
)
RATES = {
    "learning_rate": {*ENCODERS, "decoder"},
    "refiner_rate": {"refiner"},
    "auxiliary_rate": {"auxiliary"},
    "weight_rate": {"logits"},
    "step_rate": {"log_steps"},
}


@pytest.fixture(scope="module")
def variables():
    """As many parts as those of the network, of a few numbers each."""
    rng = np.random.default_rng(0)

    def numbers(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    params = {
        name: {"only": {"kernel": numbers(2, 3), "bias": numbers(3)}}
        for name in (*ENCODERS, "decoder", "refiner", "auxiliary")
    }
    steps = {name: {"only": numbers(), "global": numbers()} for name in ENCODERS}
    logits, scales = numbers(3), jnp.array([1.0, 2.0, 3.0])
    return {
        "params": params,
        "batch_stats": {"decoder": {"norm": {"mean": numbers(3)}}},
        "weighting": {"logits": logits, "scales": scales, "log_steps": steps},
    }


@pytest.fixture(scope="module")
def phase_of(variables):
    """``phase_of(method, ...)``: a phase whose network is the stand-in."""
    sizes = {"num_samples": 40, "batch_size": BATCH}

    def make(method=EVERYTHING, seed=0, **settings):
        training = MetaTrainConfig(method, **sizes | settings)
        return meta_phase(variables, PrismConfig(), training, seed)

    with pytest.MonkeyPatch.context() as patch:
        stand_in_networks.replace_networks(patch)
        yield make


def steps(phase, batch, count):
    """The states after each step, the first of all at the front, and their terms."""
    states, terms = [parallel.replicate(phase.start)], []
    batch = parallel.share(batch)
    for _ in range(count):
        state, measured = phase.step_fn(states[-1], batch)
        states.append(state)
        terms.append(dict(zip(TERMS, np.asarray(measured).tolist(), strict=True)))
    assert count < 2 or phase.step_fn._cache_size() == 1
    return states, terms


def changed(before, after):
    """By name, all that was moved."""
    before, after = (
        {**own["params"], **own["weighting"], "statistics": own["batch_stats"]}
        for own in (before, after)
    )
    return {name for name in before if not bitwise(before[name], after[name])}


def moves(phase, batch, count):
    """How far, at each step, one number of each part went down, from zero."""
    variables = jax.tree.map(jnp.zeros_like, phase.start.variables)
    phase = phase._replace(start=phase.start._replace(variables=variables))
    states, _ = steps(phase, batch, count)

    def number(state, kind, name):
        leaf = jax.tree.leaves(state.variables[kind][name])[0]
        return np.float64(np.asarray(leaf).ravel()[0])

    return {
        name: -np.diff([number(state, kind, name) for state in states])
        for kind in ("params", "weighting")
        for name in variables[kind]
    }


def test_each_rate_moves_its_own_part(phase_of, batch):
    """That of the networks rises and then follows a cosine."""
    rates = {name: 0.1 * (i + 1) for i, name in enumerate(RATES)}
    schedule = {"num_samples": 12, "warmup_steps": 1, "final_rate": 0.5}
    found = moves(phase_of(optimiser="adam", **schedule, **rates), batch, 3)
    for rate, names in RATES.items():
        constant = rate in ("weight_rate", "step_rate")
        expected = rates[rate] * np.array([1, 1, 1] if constant else [0, 1, 0.75])
        for name in names:
            np.testing.assert_allclose(found[name], expected, rtol=1e-3, atol=1e-9)


def slope_of(batch):
    """The gradient of every parameter."""
    return float(np.mean(stand_in_networks.slopes(batch.partial, batch.complete)))


def test_paper_is_plain_sgd_at_a_constant_rate(phase_of, batch):
    """To the last step, one frame at a time."""
    preset = dataclasses.replace(PRESETS["paper"].meta, num_samples=3 * 32)
    names = (field.name for field in dataclasses.fields(preset))
    found = moves(phase_of(**{name: getattr(preset, name) for name in names}), batch, 3)
    slope = slope_of(batch)
    for name in (*ENCODERS, "decoder", "refiner"):
        np.testing.assert_allclose(found[name], 5e-5 * slope, 1e-4)
    np.testing.assert_allclose(found["logits"], 5e-4 * slope, 1e-4)


def test_gradients_are_clipped_together_but_not_with_the_refiners(phase_of, batch):
    """Encoders and decoder have 27 numbers, the refiner nine."""
    slope = slope_of(batch)
    assert slope > 0.1
    found = moves(phase_of(clip_norm=0.1, **dict.fromkeys(RATES, 1.0)), batch, 1)
    sizes = dict.fromkeys((*ENCODERS, "decoder"), 27) | {"refiner": 9}
    for name, size in sizes.items():
        np.testing.assert_allclose(found[name], 0.1 / size**0.5, rtol=1e-5)
    np.testing.assert_allclose(found["logits"], slope, rtol=1e-5)


def test_what_does_not_learn_stays(phase_of, batch):
    """And a branch that does not count never has a weight."""
    method = MetaConfig(branches=("denoise", "align"), learn_refiner=False)
    phase = phase_of(method, **dict.fromkeys(RATES, 0.1))
    states, terms = steps(phase, batch, 2)
    moved = changed(states[0].variables, states[2].variables)
    assert moved == {*ENCODERS, "decoder", "logits", "scales"}
    assert np.isfinite([list(measured.values()) for measured in terms]).all()
    for state in states:
        assert jax.nn.softmax(state.variables["weighting"]["logits"])[0] == 0


@pytest.fixture(scope="module")
def whole(phase_of, batch):
    """States and terms of three steps, and the settings of their phase."""
    settings = {"average_decay": 0.8, **dict.fromkeys(RATES, 0.3)}
    return *steps(phase_of(**settings), batch, 3), settings


@pytest.mark.parametrize(("at_once", "size"), [(2, 2), (3, 1)])
def test_parts_of_a_batch_add_up_to_it(
    whole, phase_of, batch, monkeypatch, at_once, size
):
    """Perturbations are one for a step, and new for the next and with another seed."""
    expected, terms, settings = whole
    sizes = []

    def noted(variables, frames, *others):
        sizes.append(len(frames.partial))
        return stand_in_networks.meta_gradients(variables, frames, *others)

    monkeypatch.setattr(meta, "meta_gradients", noted)
    states, others = steps(phase_of(at_once=at_once, **settings), batch, 3)
    assert set(sizes) == {size}
    assert_close(states[3].variables, expected[3].variables, 2e-6)
    for a, b in zip(others, terms, strict=True):
        assert a == pytest.approx(b, rel=2e-6)
    assert all(each["align"] == 0 for each in terms)
    noise = {each["denoise"] for each in terms}
    assert len(noise) == 3
    _, (other,) = steps(phase_of(seed=1), batch, 1)
    assert other["denoise"] not in noise


def test_the_average_is_the_closed_form(whole):
    """d^n v_0 + (1 - d) sum d^(n - i) v_i, of every variable but the scales: these are
    averages already, and were none to begin with."""
    states, _, _ = whole
    assert bitwise(states[0].average, states[0].variables)
    shares = [0.8**3, *[0.2 * 0.8 ** (3 - i) for i in range(1, 4)]]
    expected = jax.tree.map(
        lambda *leaves: sum(w * x for w, x in zip(shares, leaves, strict=True)),
        *[state.variables for state in states],
    )
    expected["weighting"]["scales"] = states[3].variables["weighting"]["scales"]
    assert bitwise(states[3].kept, states[3].average)
    assert_close(states[3].average, expected, 1e-5)


def test_terms_and_scales(whole, variables, batch):
    """Scales begin anew. The weights among the terms are those after the step."""
    states, terms, _ = whole
    assert changed(variables, states[0].variables) == {"scales"}
    assert (np.asarray(states[0].variables["weighting"]["scales"]) == 0).all()
    expected, slope = terms[0]["denoise"], slope_of(batch)
    for state, measured in zip(states[1:], terms, strict=True):
        expected = 0.99 * expected + 0.01 * measured["denoise"]
        weighting = state.variables["weighting"]
        np.testing.assert_allclose(weighting["scales"][1], expected, rtol=1e-6)
        weights = np.exp(weighting["logits"]) / np.exp(weighting["logits"]).sum()
        assert measured == pytest.approx(
            {
                "zero_step": 2.0 + slope,
                "objective": 3.0 + slope,
                "depth_consistency": 4.0 + slope,
                "normal": 0.0,
                "denoise": measured["denoise"],
                "align": 0.0,
                "refined": 8.0 + slope,
                "weight_normal": weights[0],
                "weight_denoise": weights[1],
                "weight_align": weights[2],
                "weight_entropy": -(weights * np.log(weights)).sum(),
                "adapted": 1.0 + slope,
            },
            rel=1e-5,
        )


@pytest.mark.parametrize("measured", [None, 0.25])
def test_validation_scores(phase_of, batch, variables, measured):
    """CD-L2 before, whether the adapted one was taken, and CD-L2 of what was."""
    if measured is not None:
        known = jax.tree.map(lambda leaf: np.stack([leaf] * BATCH), nothing_known(4))
        known.state[:, :1] = SURFACE
        batch = batch._replace(visibility=known)
    above = np.array([True, False, True, True])
    eye = batch.eye.copy()
    eye[:, 2] = np.where(above, 1, -1) * np.abs(eye[:, 2])
    batch = batch._replace(eye=eye)
    scores = np.asarray(phase_of().validate_fn(variables, batch))

    def area(points, complete, scale):
        there = cKDTree(complete).query(points)[0]
        back = cKDTree(points).query(complete)[0]
        return scale**2 * ((there**2).mean() + (back**2).mean())

    for i in range(BATCH):
        rest = batch.complete[i], batch.scale[i]
        moved = (0.05 + (measured or 0.0)) * batch.eye[i] * above[i]
        before, after = batch.partial[i], batch.partial[i] + moved
        expected = [area(before, *rest), above[i], area(after, *rest)]
        np.testing.assert_allclose(scores[i], expected, rtol=1e-4)


def test_settings_under_which_nothing_is_learned_are_refused():
    for changes in ({"weight_rule": "meta"}, {"learn_auxiliary": True}):
        with pytest.raises(InputError, match=f"cannot train {next(iter(changes))}"):
            check_meta(MetaTrainConfig(MetaConfig(first_order=True, **changes)))
    check_meta(MetaTrainConfig(MetaConfig(first_order=True, learn_steps=True)))
