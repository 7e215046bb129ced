"""The phase of meta-training: one step of the network, all others of a stand-in."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from prism_jax.adaptation.config import MetaConfig, PrismConfig
from prism_jax.adaptation.meta import MetaTerms
from prism_jax.adaptation.objective import Losses
from prism_jax.data.pipeline import Framing
from prism_jax.geometry.visibility import SURFACE, nothing_known
from prism_jax.io.errors import InputError
from prism_jax.losses.weighting import loss_weights
from prism_jax.models.variables import ENCODERS
from prism_jax.training import meta, parallel
from prism_jax.training.config import MetaTrainConfig
from prism_jax.training.meta import SCORES, TERMS, check_meta, meta_phase
from prism_jax.training.presets import PRESETS
from tests import stand_in_networks
from tests.trees import bitwise

BATCH, FRAMING = 4, Framing(64, 128, 1.4)
EVERYTHING = MetaConfig(
    weight_rule="meta", rehearse_depth=True, learn_steps=True, learn_auxiliary=True
)


@pytest.fixture(scope="module")
def batch(examples, framed):
    return framed(examples, range(BATCH), FRAMING)


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


@pytest.fixture
def phase_of(variables, monkeypatch, quick_jit):
    """``phase_of(config, ...)``: a phase whose network is the stand-in."""
    stand_in_networks.replace_networks(monkeypatch)

    def make(config, seed=0, jit=quick_jit):
        phase = meta_phase(variables, PrismConfig(), config, seed)
        return phase._replace(step_fn=jit(phase.step_fn))

    return make


def steps(phase, batch, count):
    """The states after each step, the first of all at the front, and their terms."""
    mesh = parallel.data_mesh()
    states, terms = [parallel.replicate(phase.start, mesh)], []
    batch = parallel.share(batch, mesh)
    for _ in range(count):
        state, measured = phase.step_fn(states[-1], batch)
        states.append(state)
        terms.append(dict(zip(TERMS, np.asarray(measured).tolist(), strict=True)))
    return states, terms


def parts(variables):
    """By name, all that a step moves or leaves."""
    weighting = variables["weighting"]
    statistics = {"batch_stats": variables["batch_stats"]}
    return {**variables["params"], **weighting, **statistics}


def changed(before, after):
    before, after = parts(before), parts(after)
    assert before.keys() == after.keys()
    return {name for name in before if not bitwise(before[name], after[name])}


def slope_of(batch):
    return float(np.mean(stand_in_networks.slopes(batch.partial, batch.complete)))


# The network.


@pytest.fixture(scope="module")
def real_phase(minimal, minimal_variables):
    config = MetaTrainConfig(
        EVERYTHING,
        num_samples=16,
        batch_size=2,
        num_complete=128,
        optimiser="adam",
        learning_rate=1e-3,
        average_decay=0.75,
    )
    return meta_phase(minimal_variables, minimal.config, config, seed=0)


@pytest.fixture(scope="module")
def real_step(real_phase, examples, framed, quick_jit):
    batch = framed(examples, range(2), FRAMING)
    return quick_jit(real_phase.step_fn)(real_phase.start, batch)


@pytest.mark.slow
def test_a_step_of_the_network_moves_what_learns_and_nothing_else(
    real_phase, real_step
):
    state, terms = real_step
    before, after = real_phase.start.variables, state.variables
    modules = (*ENCODERS, "decoder", "refiner", "auxiliary")
    assert changed(before, after) == {*modules, "logits", "log_steps", "scales"}
    for name in modules:
        assert before["params"][name].keys() == after["params"][name].keys()
        for module in before["params"][name]:
            same = bitwise(
                before["params"][name][module], after["params"][name][module]
            )
            assert not same, (name, module)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, terms)))
    assert int(state.step) == 1
    measured = dict(zip(TERMS, np.asarray(terms), strict=True))
    scales = [measured[name] for name in ("normal", "denoise", "align")]
    np.testing.assert_allclose(after["weighting"]["scales"], scales, rtol=1e-6)


@pytest.mark.slow
def test_the_average_of_the_network_follows(real_phase, real_step):
    state, _ = real_step
    before, after = real_phase.start.variables, state.variables
    expected = jax.tree.map(lambda b, a: 0.75 * b + 0.25 * a, before, after)
    expected["weighting"]["scales"] = after["weighting"]["scales"]
    for a, b in zip(*map(jax.tree.leaves, (state.average, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
    assert bitwise(state.kept, state.average)


# The stand-in.


def test_the_phase_is_what_the_configuration_says(phase_of):
    config = MetaTrainConfig(EVERYTHING, 96, 12, num_complete=512)
    phase = phase_of(config)
    assert phase.name == "meta"
    assert (phase.num_samples, phase.batch_size, phase.num_complete) == (96, 12, 512)
    assert phase.terms == TERMS
    assert phase.scores == SCORES == ("unadapted", "accepted", "adapted")
    assert phase.start.average is None
    assert int(phase.start.step) == 0


RATES = {
    "learning_rate": {*ENCODERS, "decoder"},
    "refiner_rate": {"refiner"},
    "auxiliary_rate": {"auxiliary"},
    "weight_rate": {"logits"},
    "step_rate": {"log_steps"},
}


@pytest.mark.parametrize("rate", RATES)
def test_each_rate_moves_its_own_part(phase_of, batch, rate):
    """With the others none, all else stays bit for bit, but for the scales."""
    rates = {name: 0.1 * (name == rate) for name in RATES}
    phase = phase_of(MetaTrainConfig(EVERYTHING, 40, 4, optimiser="adam", **rates))
    states, _ = steps(phase, batch, 2)
    assert changed(states[0].variables, states[2].variables) == {
        *RATES[rate],
        "scales",
    }


@pytest.mark.parametrize(
    ("learn_steps", "learn_refiner"), [(False, True), (True, False)]
)
def test_what_does_not_learn_stays(phase_of, batch, learn_steps, learn_refiner):
    method = MetaConfig(learn_steps=learn_steps, learn_refiner=learn_refiner)
    phase = phase_of(
        MetaTrainConfig(method, 40, 4, learning_rate=0.1, refiner_rate=0.1)
    )
    states, _ = steps(phase, batch, 2)
    expected = {*ENCODERS, "decoder", "logits", "scales"}
    expected |= {"refiner"} if learn_refiner else set()
    expected |= {"log_steps"} if learn_steps else set()
    assert changed(states[0].variables, states[2].variables) == expected


def test_branches_that_do_not_count_never_have_a_weight(phase_of, batch):
    method = MetaConfig(branches=("denoise", "align"))
    phase = phase_of(MetaTrainConfig(method, 40, 4, weight_rate=0.1))
    states, terms = steps(phase, batch, 3)
    assert np.isfinite([list(measured.values()) for measured in terms]).all()
    for state in states:
        weights = loss_weights(state.variables["weighting"]["logits"])
        assert weights[0] == 0
        assert np.isclose(weights.sum(), 1)
        assert np.isfinite(state.variables["weighting"]["scales"]).all()


def moves(states, *path):
    """How far, at each step, one number went down."""

    def pick(state):
        tree = state.variables
        for name in path:
            tree = tree[name]
        return np.float64(jax.tree.leaves(tree)[0].ravel()[0])

    values = np.array([pick(state) for state in states])
    return values[:-1] - values[1:]


def at_zero(phase):
    """From parameters of zero, whose small moves float32 tells apart."""
    variables = jax.tree.map(jnp.zeros_like, phase.start.variables)
    return phase._replace(start=phase.start._replace(variables=variables))


def test_paper_is_plain_sgd_at_a_constant_rate(phase_of, batch):
    """To the last step: 5e-5, and 5e-4 for the loss weights, one frame at a time."""
    preset = PRESETS["paper"].meta
    assert (preset.optimiser, preset.batch_size, preset.at_once) == ("sgd", 32, 4)
    assert preset.average_decay == 0
    phase = at_zero(phase_of(dataclasses.replace(preset, num_samples=6 * 32)))
    states, _ = steps(phase, batch, 6)
    slope = slope_of(batch)
    for name in (*ENCODERS, "decoder", "refiner"):
        np.testing.assert_allclose(moves(states, "params", name), 5e-5 * slope, 1e-4)
    logits = moves(states, "weighting", "logits")
    np.testing.assert_allclose(logits, 5e-4 * slope, 1e-4)
    assert bitwise(
        states[6].variables["weighting"]["log_steps"],
        states[0].variables["weighting"]["log_steps"],
    )


def test_small_warms_up_and_follows_a_cosine(phase_of, batch):
    """Adam under a constant gradient moves by the rate itself."""
    preset = PRESETS["small"].meta
    assert (preset.optimiser, preset.final_rate) == ("adam", 0.01)
    peak = preset.learning_rate
    short = dataclasses.replace(preset, num_samples=30 * 32, warmup_steps=10)
    phase = at_zero(phase_of(short))
    states, _ = steps(phase, batch, 32)
    expected = [peak * i / 10 for i in range(10)]
    for i in range(21):
        cosine = 0.5 * (1 + np.cos(np.pi * i / 20))
        expected.append(peak * (0.01 + 0.99 * cosine))
    expected.append(0.01 * peak)
    for name in (*ENCODERS, "decoder"):
        found = moves(states, "params", name)
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-9)
    auxiliary = np.array(expected) * preset.auxiliary_rate / peak
    found = moves(states, "params", "auxiliary")
    np.testing.assert_allclose(found, auxiliary, rtol=1e-3, atol=1e-9)
    learned = moves(states, "weighting", "log_steps")
    np.testing.assert_allclose(learned, preset.step_rate, rtol=1e-3)
    logits = moves(states, "weighting", "logits")
    np.testing.assert_allclose(logits, preset.weight_rate, rtol=1e-3)
    assert (moves(states, "params", "refiner") == 0).all()


def test_gradients_are_clipped_together_but_not_with_the_refiners(phase_of, batch):
    """Encoders and decoder have 27 numbers, the refiner nine."""
    slope = slope_of(batch)
    assert slope > 0.1
    config = MetaTrainConfig(
        EVERYTHING, 40, 4, clip_norm=0.1, **dict.fromkeys(RATES, 1.0)
    )
    states, _ = steps(at_zero(phase_of(config)), batch, 1)
    for name in (*ENCODERS, "decoder"):
        found = moves(states, "params", name)
        np.testing.assert_allclose(found, 0.1 / 27**0.5, rtol=1e-5)
    found = moves(states, "params", "refiner")
    np.testing.assert_allclose(found, 0.1 / 9**0.5, rtol=1e-5)
    np.testing.assert_allclose(moves(states, "weighting", "logits"), slope, rtol=1e-5)


@pytest.mark.parametrize("at_once", [2, 3])
def test_parts_of_a_batch_add_up_to_it(phase_of, batch, monkeypatch, at_once):
    """To float32's rounding; and no more frames are seen at once than were asked."""
    whole = MetaTrainConfig(EVERYTHING, 40, 4, **dict.fromkeys(RATES, 0.1))
    expected, terms = steps(phase_of(whole), batch, 3)
    sizes = []

    def noted(variables, frames, *others):
        sizes.append(len(frames.partial))
        return stand_in_networks.meta_gradients(variables, frames, *others)

    monkeypatch.setattr(meta, "meta_gradients", noted)
    states, others = steps(
        phase_of(dataclasses.replace(whole, at_once=at_once)), batch, 3
    )
    assert set(sizes) == {{2: 2, 3: 1}[at_once]}
    for a, b in zip(
        *map(jax.tree.leaves, (states[3].variables, expected[3].variables)), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-7)
    for a, b in zip(others, terms, strict=True):
        assert a == pytest.approx(b, rel=2e-6)


def test_the_average_is_the_closed_form(phase_of, batch):
    """d^n v_0 + (1 - d) sum d^(n - i) v_i, of every variable but the scales: these are
    averages already, and were none to begin with."""
    rates = dict.fromkeys(RATES, 0.3)
    config = MetaTrainConfig(EVERYTHING, 40, 4, average_decay=0.8, **rates)
    phase = phase_of(config)
    states, _ = steps(phase, batch, 5)
    assert bitwise(states[0].average, states[0].variables)
    shares = [0.8**5, *[0.2 * 0.8 ** (5 - i) for i in range(1, 6)]]
    assert sum(shares) == pytest.approx(1)
    expected = jax.tree.map(
        lambda *leaves: sum(
            w * np.float64(x) for w, x in zip(shares, leaves, strict=True)
        ),
        *[state.variables for state in states],
    )
    assert bitwise(states[5].kept, states[5].average)
    last = states[5].variables["weighting"]["scales"]
    assert np.array_equal(states[5].average["weighting"]["scales"], last)
    expected["weighting"]["scales"] = last
    for a, b in zip(*map(jax.tree.leaves, (states[5].average, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    # The steps themselves know nothing of it.
    alone, _ = steps(phase_of(dataclasses.replace(config, average_decay=0.0)), batch, 5)
    assert alone[5].average is None
    assert bitwise(alone[5].variables, states[5].variables)
    assert bitwise(alone[5].kept, alone[5].variables)


def test_terms_have_their_names(phase_of, batch, variables, monkeypatch):
    """And the weights are those after the step."""

    def fixed(variables, *others):
        grads, _ = stand_in_networks.meta_gradients(variables, *others)
        grads["weighting"]["logits"] = jnp.array([1.0, 0.0, -3.0])
        losses = Losses(*jnp.array([1.0, 2.0, 3.0, 4.0, 5.0]))
        return grads, MetaTerms(
            jnp.float32(0.1), jnp.float32(0.2), losses, jnp.float32(0.3)
        )

    phase = phase_of(MetaTrainConfig(EVERYTHING, 40, 4, weight_rate=0.5))
    monkeypatch.setattr(meta, "meta_gradients", fixed)
    _, (terms,) = steps(phase, batch, 1)
    logits = np.float64(variables["weighting"]["logits"]) - [0.5, 0, -1.5]
    weights = np.exp(logits) / np.exp(logits).sum()
    expected = {
        "adapted": 0.1,
        "zero_step": 0.2,
        "refined": 0.3,
        "objective": 1.0,
        "depth_consistency": 2.0,
        "normal": 3.0,
        "denoise": 4.0,
        "align": 5.0,
        "weight_normal": weights[0],
        "weight_denoise": weights[1],
        "weight_align": weights[2],
        "weight_entropy": -(weights * np.log(weights)).sum(),
    }
    assert set(terms) == set(TERMS)
    assert terms == pytest.approx(expected, rel=1e-5)
    assert TERMS[-1] == "adapted"


def test_scales_are_measured_anew(phase_of, batch, variables):
    """From none, whatever the weights came with; then as moving averages."""
    assert (np.asarray(variables["weighting"]["scales"]) > 0).all()
    phase = phase_of(MetaTrainConfig(EVERYTHING, 40, 4))
    assert (np.asarray(phase.start.variables["weighting"]["scales"]) == 0).all()
    states, terms = steps(phase, batch, 3)
    expected = terms[0]["denoise"]
    for state, measured in zip(states[1:], terms, strict=True):
        expected = 0.99 * expected + 0.01 * measured["denoise"]
        scale = state.variables["weighting"]["scales"][1]
        np.testing.assert_allclose(scale, expected, rtol=1e-6)
    assert changed(variables, phase.start.variables) == {"scales"}


def test_perturbations_are_one_for_a_step_and_new_for_the_next(phase_of, batch):
    config = MetaTrainConfig(EVERYTHING, 40, 4)
    _, terms = steps(phase_of(config), batch, 3)
    assert all(each["align"] == 0 for each in terms)
    noise = [each["denoise"] for each in terms]
    assert len(set(noise)) == 3
    _, again = steps(phase_of(dataclasses.replace(config, at_once=1)), batch, 3)
    assert [each["denoise"] for each in again] == pytest.approx(noise, rel=1e-6)
    _, other = steps(phase_of(config, seed=1), batch, 3)
    assert not {each["denoise"] for each in other} & set(noise)


def test_frames_get_the_indices_that_come_with_the_batch(phase_of, batch):
    """Of 16 bits in the table, of 32 in the frame: their sum is beyond 16."""
    indices = {"rows": np.full((BATCH, 3), 40_000, np.uint16)}
    phase = phase_of(MetaTrainConfig(EVERYTHING, 40, 4))
    _, terms = steps(phase, batch._replace(indices=indices), 1)
    assert terms[0]["normal"] == BATCH * 3 * 40_000
    _, terms = steps(phase, batch, 1)
    assert terms[0]["normal"] == 0


def test_every_step_is_of_one_compilation(phase_of, batch):
    config = MetaTrainConfig(EVERYTHING, 40, 4, average_decay=0.5, warmup_steps=2)
    phase = phase_of(config, jit=lambda step: step)
    steps(phase, batch, 4)
    assert phase.step_fn._cache_size() == 1


@pytest.mark.parametrize("measured", [None, 0.25])
def test_validation_scores(phase_of, batch, variables, measured):
    """CD-L2 before, whether the adapted one was taken, and CD-L2 of what was; a batch's
    maps reach the adaptation."""
    if measured is not None:
        known = jax.tree.map(lambda leaf: np.stack([leaf] * BATCH), nothing_known(4))
        known.state[:, :1] = SURFACE
        batch = batch._replace(visibility=known)
    above = np.array([True, False, True, True])
    eye = batch.eye.copy()
    eye[:, 2] = np.where(above, 1, -1) * np.abs(eye[:, 2])
    batch = batch._replace(eye=eye)
    scores = np.asarray(phase_of(MetaTrainConfig()).validate_fn(variables, batch))
    assert scores.shape == (BATCH, 3)
    for i in range(BATCH):
        complete, partial = batch.complete[i], batch.partial[i]
        after = partial + (0.05 + (measured or 0.0)) * batch.eye[i] * above[i]

        def chamfer(points, complete=complete):
            there = cKDTree(complete).query(points)[0]
            back = cKDTree(points).query(complete)[0]
            return (there**2).mean() + (back**2).mean()

        area = batch.scale[i] ** 2
        expected = [area * chamfer(partial), above[i], area * chamfer(after)]
        np.testing.assert_allclose(scores[i], expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"first_order": True, "weight_rule": "meta"}, "cannot train weight_rule"),
        ({"first_order": True, "learn_auxiliary": True}, "cannot train learn_aux"),
    ],
)
def test_settings_under_which_nothing_is_learned_are_refused(changes, fault):
    config = MetaTrainConfig(dataclasses.replace(MetaConfig(), **changes))
    with pytest.raises(InputError, match=fault):
        check_meta(config)
    check_meta(MetaTrainConfig(MetaConfig(first_order=True, learn_steps=True)))
