"""The label-free training on one's own frames: what it reads, teaches and refuses."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments import plant
from experiments.assets import CELLS
from experiments.plants import frames as parts
from experiments.plants.frames import PlantConfig, pseudo_label, student_view
from prism_jax.completion.weights import load_pretrained, read_metadata
from prism_jax.data.pipeline import Framing, stack
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError
from prism_jax.losses.primary import primary_loss
from prism_jax.models.variables import ENCODERS
from prism_jax.reporting.model_card import model_card
from tests import launching
from tests.trees import bitwise, equal

EYE = np.array([3.0, -4.0, 2.5], np.float32)
RNG = np.random.default_rng(0)
CLOUD = (RNG.uniform(-1, 1, (500, 3)) * [1.0, 0.5, 0.7]).astype(np.float32)
SETTINGS = PlantConfig(2, num_label=96, num_hidden=32, auxiliary_weight=0.0)


def half_box(seed, count=400):
    """The sides of a box that `EYE` sees."""
    rng = np.random.default_rng(seed)
    shell = rng.uniform(-1, 1, (4 * count, 3))
    shell /= np.abs(shell).max(axis=1, keepdims=True)
    facing = (np.round(shell, 6) * (np.abs(shell) > 0.999)) @ EYE > 0
    size = rng.uniform(0.4, 0.8, 3)
    return (shell[facing][:count] * size).astype(np.float32)


class Boxes:
    """Six sequences of two frames, of any truth, which may not be a number."""

    objects = np.repeat(np.arange(6), 2)

    def __init__(self, truth=np.nan, **changes):
        self._truth, self._changes = truth, changes

    def __getitem__(self, index):
        truth = np.full((300, 3), self._truth, np.float32)
        example = Example(truth, half_box(index), EYE, "a", f"box {index}")
        return example._replace(**self._changes)


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config.with_model(background="unknown")


@pytest.fixture(scope="module")
def read(config):
    """``read(count, truth, field=...)``: frames of `Boxes`."""
    return lambda count=12, *truth, **changes: [
        parts.read_frame(Boxes(*truth, **changes), row, config.model)
        for row in range(count)
    ]


@pytest.fixture(scope="module")
def framing(config):
    model = config.model
    return Framing(model.backbone.num_points, 96 + 32, model.margin, model.heading)


def part(points, eye, seed):
    example = Example(None, points, eye, "", "")
    return parts.occluded(example, np.random.default_rng(seed))


def test_a_cloud_is_parted():
    for seed in range(3):
        kept, hidden, eye = part(CLOUD, EYE, seed)
        both = np.concatenate([kept, hidden])
        assert sorted(map(tuple, both)) == sorted(map(tuple, CLOUD))
        low, high = parts.HIDDEN_SHARES
        assert low <= len(hidden) / len(CLOUD) <= high
        np.testing.assert_array_equal(part(CLOUD, EYE, seed)[0], kept)
        assert np.isclose(*np.linalg.norm([eye, EYE], axis=1), rtol=0.1)
    assert part(CLOUD, None, 0)[2] is None
    for seed, count in enumerate((4, 4, 70, 70)):
        flat = CLOUD[:count] * np.float32([1, 1, 0])
        assert all(len(each) for each in part(flat, EYE, seed)[:2])
    with pytest.raises(ValueError, match="too few"):
        part(CLOUD[:3], EYE, 0)


def test_a_frame_holds_what_was_measured_and_no_truth(read, config):
    example, number, seen = read(6, 1.0)[5]
    assert (example.complete, example.name, number) == (None, "box 5", 2)
    np.testing.assert_array_equal(example.partial, half_box(5))
    partial = seen.workspace.from_unit(seen.partial)
    assert KDTree(example.partial).query(partial)[0].max() < 1e-5
    (blind,) = read(1, eye=np.full(3, np.nan, np.float32))
    assert blind.example.eye is None and not blind.seen.sensor_known
    with pytest.raises(InputError, match="no measured points"):
        read(partial=None)


def test_every_fifth_sequence_checks_or_every_fifth_frame(read):
    frames = [parts.PlantFrame(None, n // 3, None) for n in range(33)]
    train, check = plant.held_out(frames)
    assert {frame.object for frame in check} == {2, 7} and len(check) == 6
    assert len(train) == 27
    frames = [parts.PlantFrame(n, 0, None) for n in range(11)]
    assert [frame.example for frame in plant.held_out(frames)[1]] == [2, 7]
    with pytest.raises(InputError, match="too few"):
        plant.held_out(frames[:4])


def test_a_label_is_what_was_measured_and_what_agrees_with_it(read):
    (frame,) = read(1)
    eye, partial = np.asarray(frame.seen.eye), np.asarray(frame.seen.partial)
    behind = partial - 0.5 * eye / np.linalg.norm(eye)
    before = 0.5 * (partial + eye)
    to_unit = frame.seen.workspace.to_unit
    both = np.concatenate([behind, before]).astype(float)
    label = functools.partial(pseudo_label, frame)
    far = label(both, PlantConfig(num_label=900, reach=9.0))
    assert far.shape == (900, 3)
    unit = np.asarray(to_unit(far))
    assert KDTree(before).query(unit)[0].min() > 0.1
    assert (KDTree(behind).query(unit)[0] < 1e-5).sum() > 10
    assert KDTree(far).query(frame.example.partial)[0].max() < 0.2
    near = np.asarray(to_unit(label(both, PlantConfig(num_label=900, reach=0.1))))
    measured = np.asarray(to_unit(frame.example.partial))
    assert KDTree(measured).query(near)[0].max() <= 0.1 + 1e-6


@pytest.fixture
def loop(config, read, monkeypatch):
    """``loop(truth, steps, minutes, loss)``: of a training whose steps add one to the
    average, what comes back, and its batches."""

    def adapt(truth=np.nan, steps=3, minutes=np.inf, loss=1.0):
        batches = []

        def step(fixed, state, batch, *rest):
            batches.append(batch)
            average = jax.tree.map(lambda leaf: leaf + 1.0, state.kept)
            return state._replace(average=average), loss

        monkeypatch.setattr(plant, "step", step)
        names = (*ENCODERS, "decoder", "refiner")
        variables = {"params": dict.fromkeys(names, jnp.zeros(2))}
        given = config, variables, read(12, truth), SETTINGS, 0, steps, minutes
        return *plant.adapt(*given), batches

    points = lambda variables, seen, model: np.array(seen.partial)  # noqa: E731
    monkeypatch.setattr(plant, "complete", points)
    return adapt


def test_the_average_comes_back_and_no_truth_is_looked_at(loop):
    """It is not a number in one, and zero in the other, which the clock might end."""
    found, told, batches = loop()
    params = found["params"]
    assert told["steps"] == len(batches) == 3 and told["frames"] == 10
    assert all((params[name] == 3.0).all() for name in (*ENCODERS, "decoder"))
    assert not params["refiner"].any()
    _, again, others = loop(truth=0.0, minutes=1e6)
    assert again == told and bitwise(others, batches)
    _, told, batches = loop(steps=None, minutes=0.0)
    assert told["steps"] == len(batches) == 0 and not told["check"]["passed"]
    with pytest.raises(FloatingPointError, match="loss nan at step 0"):
        loop(loss=np.nan)


@pytest.mark.slow
def test_steps_move_the_encoders_and_the_decoder(read, config, minimal_fresh):
    given = config, minimal_fresh, read(), SETTINGS, 0, 2
    found, told = plant.adapt(*given)
    pairs = minimal_fresh["params"], found["params"]
    same = {name for name in pairs[0] if equal(*(pair[name] for pair in pairs))}
    assert same == {*pairs[0]} - {*ENCODERS, "decoder"}
    before, after = told["check"]["hidden"]
    assert 0 < before != after > 0


def test_the_loss_is_eq_10_and_what_was_hidden(read, framing, config, monkeypatch):
    """Of a stand-in that predicts what it reads, moved."""

    def predict(variables, inputs, model):
        points = inputs + variables["params"]["decoder"]
        return types.SimpleNamespace(stages=(inputs[:32], inputs), points=points)

    monkeypatch.setattr(plant, "framed_view", lambda *given: None)
    monkeypatch.setattr(plant, "prepare_input", lambda partial, *given: partial)
    monkeypatch.setattr(plant, "predict", predict)
    rng, example = np.random.default_rng(0), read(1)[0].example
    batch = stack([student_view(example, CLOUD[:96], SETTINGS, framing, rng)])
    moved, fixed = {"decoder": jnp.float32(0.1)}, {"params": {"decoder": 0.0}}
    partial, wanted = batch.partial[0], batch.complete[0]

    @jax.jit
    def both(batch, key, partial, label):
        loss = plant.student_loss(moved, fixed, batch, key, config, SETTINGS)
        return loss, primary_loss((partial[:32], partial + 0.1), label, "l1")

    loss, expected = both(batch, jax.random.key(0), partial, wanted[:96])
    gaps = np.linalg.norm(wanted[96:, None] - partial - 0.1, axis=-1)
    hidden = SETTINGS.hidden_weight * gaps.min(1).mean()
    np.testing.assert_allclose(loss, expected + hidden, rtol=1e-5)


def evidence(hidden, contradicted=0.0):
    hidden = np.asarray(hidden)
    rows = np.arange(len(hidden)) // 2, hidden, np.full(len(hidden), contradicted)
    return np.stack(rows, axis=1)


HIDDEN = np.linspace(0.1, 0.2, 12)


def test_better_is_nearer_to_what_was_hidden_and_no_fuller_of_errors():
    """By a tenth or more, and for certain, which the last one is in the mean alone."""
    for after, better in [
        (evidence(0.8 * HIDDEN), True),
        (evidence(0.95 * HIDDEN), False),
        (evidence(0.8 * HIDDEN, contradicted=0.1), False),
        (evidence(0.8 * HIDDEN, contradicted=0.005), True),
        (evidence(HIDDEN * np.repeat([0.3, 1.2] * 3, 2)), False),
    ]:
        told = plant.verdict(evidence(HIDDEN), after)
        assert told["passed"] == better
        assert np.isclose(told["change"][0], after[:, 1].mean() / HIDDEN.mean() - 1)


def test_what_held_out_frames_say(read, config, monkeypatch):
    """Of points that are those read, and of points before the measured surface, which
    the sensor that was there contradicts."""
    frames = read()
    say = functools.partial(plant.evidence, {}, model=config.model)
    monkeypatch.setattr(plant, "complete", lambda _, seen, __: np.array(seen.partial))
    found = say(frames)
    assert len(found) == plant.LOOKS * len(frames) and set(found[:, 0]) == set(range(6))
    assert (found[:, 1] > 0.02).all() and found[:, 2].max() < 0.05
    np.testing.assert_array_equal(say(frames), found)
    hidden, seen = parts.hide(frames[0].example, 0, config.model)
    ways = KDTree(np.array(seen.partial)).query(seen.workspace.to_unit(hidden))[0]
    np.testing.assert_allclose(found[0, 1], ways.mean(), rtol=1e-4)
    nearer = lambda _, seen, __: np.array(0.6 * seen.partial + 0.4 * seen.eye)  # noqa: E731
    monkeypatch.setattr(plant, "complete", nearer)
    found = say(frames[:4])
    assert set(found[:, 0]) == set(range(4)) and (found[:, 2] > 0.9).sum() >= 3


def test_only_what_is_better_is_written_with_where_it_comes_from(
    minimal, minimal_fresh, tmp_path, monkeypatch, capsys
):
    """What was hidden is as far as before, and then nearer, after the training."""
    seen, output = [], tmp_path / "mine.safetensors"

    def run(factor, *arguments):
        def adapt(config, variables, frames, settings, seed, steps, minutes):
            seen[:] = len(frames), settings.whole, seed, steps, minutes
            check = plant.verdict(evidence(HIDDEN), evidence(factor * HIDDEN))
            told = {"frames": len(frames), "steps": steps or 7, "check": check}
            return variables, told

        monkeypatch.setattr(plant, "adapt", adapt)
        given = f"--recordings={CELLS}", f"--output={output}", *arguments
        return launching.run(plant, *given)

    loaded = minimal.config, minimal_fresh
    monkeypatch.setattr(plant, "load_pretrained", lambda name: loaded)
    assert run(1.0, "--frames=2") == 1
    assert seen == [2, PlantConfig().whole, 0, None, 15.0] and not output.exists()
    error = capsys.readouterr().err
    assert "plant: not written: no certain 10 % gain on hidden points" in error
    assert run(0.8, "--frames=7", "--steps=5", "--set=whole=0.5", "--seed=3") == 0
    assert seen == [7, 0.5, 3, 5, np.inf]
    config, variables = load_pretrained(str(output))
    assert config == minimal.config and equal(variables, minimal_fresh)
    about = read_metadata(str(output))
    assert (about["data"], about["seed"], about["samples"]) == ("recordings", 3, 40)
    assert about["pretrained"]["preset"] == "small" and "calibration" not in about
    origin = about["adapted"]
    assert (origin["from"], origin["frames"], origin["steps"]) == ("small", 7, 5)
    told = "Adapted without labels from small. 5 steps on 7 frames"
    assert told in model_card(str(output))
