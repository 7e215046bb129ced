"""What fits verdicts, on samples whose errors are known functions of the evidence."""

import json

import numpy as np
import pytest

from experiments import point_errors, trust
from experiments.shifts import View
from experiments.trust import (
    SETS,
    Sample,
    fitted,
    judged_unseen,
    measured,
    unfitted,
)
from prism_jax.data.source import Example
from prism_jax.trust import EVIDENCE, Calibration
from prism_jax.weights import file_sha256, save_weights
from tests import launching

RNG = np.random.default_rng(0)
BLANK = unfitted(RNG.normal(size=(200, 30)) * np.geomspace(1, 1e-3, 30))


def samples(count, seed, noise=0.1):
    """The error grows with the square of what strays, whatever the rest is."""
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        evidence = {name: float(np.exp(rng.normal(-3, 1))) for name in EVIDENCE}
        error = 0.3 * (evidence["strays"] + 1e-3) ** 2 * np.exp(rng.normal(0, noise))
        name = SETS[number % len(SETS)]
        half_extent = float(rng.uniform(0.5, 2))
        made.append(
            Sample(
                name, number // 3, "tilt", evidence, half_extent, error * half_extent
            )
        )
    return made


def judged_by(calibration, samples):
    judge = calibration.judge
    return samples, [judge(sample.evidence, sample.half_extent) for sample in samples]


@pytest.fixture(scope="module")
def calibration():
    return fitted(BLANK, samples(600, 0))


def test_a_law_is_found(calibration):
    off = [
        np.log(calibration.expected_error(s.evidence) * s.half_extent / s.error)
        for s in samples(200, 1)
    ]
    # Errors range over four thousand to one, in steps of the trees.
    assert np.median(np.abs(off)) < 0.25 and np.quantile(np.abs(off), 0.95) < 0.6


def test_it_is_right_about_others_by_its_own_account(calibration):
    told = measured(*judged_by(calibration, samples(400, 2)))
    assert set(told) == {"all", *SETS, "tilt"}
    everything = told["all"]
    assert everything["views"] == 400
    assert everything["rank_correlation"] > 0.95
    assert everything["worst_tenth_low"] > 0.85
    assert everything["better_half_low"] < 0.1
    assert (
        everything["error_of_high"] < everything["error"] < everything["error_of_low"]
    )
    assert everything["expected"] == pytest.approx(everything["error"], rel=0.15)


def test_no_object_is_judged_by_what_saw_it():
    """What sets one object apart and makes its error is no evidence for itself."""
    others = [s._replace(group=5 * s.group + 1 + s.group % 2) for s in samples(40, 6)]
    usual = samples(1, 7)[0]
    odd = usual._replace(error=1e3 * usual.half_extent)
    verdict = judged_unseen(BLANK, [odd, *others])[0]
    assert verdict.expected_error < 0.1 * odd.error
    assert verdict == judged_unseen(BLANK, [usual, *others])[0]


def test_it_finds_nothing_where_nothing_is():
    """Errors that have nothing to do with the evidence are not foretold."""
    rng = np.random.default_rng(3)
    blind = [s._replace(error=float(np.exp(rng.normal()))) for s in samples(400, 4)]
    rest = [s._replace(error=float(np.exp(rng.normal()))) for s in samples(400, 5)]
    rest = [s._replace(half_extent=1.0) for s in rest]
    told = measured(*judged_by(fitted(BLANK, blind), rest))
    assert abs(told["all"]["rank_correlation"]) < 0.2


def test_what_is_familiar_is_a_spread_away():
    features = RNG.normal(size=(500, 30)) * np.geomspace(1, 1e-2, 30) + 3.0
    found = unfitted(features)
    novelties = np.array([found.novelty(row) for row in features])
    assert np.sqrt((novelties**2).mean()) == pytest.approx(1.0, rel=0.02)
    assert found.novelty(features[0] + 1.0) > 3.0


def test_few_and_equal_features_are_no_fault():
    found = unfitted(np.ones((3, 5)))
    assert np.isfinite(found.novelty(np.ones(5)))


def test_weights_of_one_pose_are_refused(tmp_path, minimal, minimal_fresh, capsys):
    """At once, before anything is built or completed."""
    weights = tmp_path / "one.safetensors"
    save_weights(weights, minimal.config, minimal_fresh, {})
    for command in (trust, point_errors):
        assert launching.run(command, f"--weights={weights}") == 2
        said = capsys.readouterr().err
        assert "one.safetensors: completes in fewer than the 3 poses" in said


def test_the_command_fits_and_measures(
    tmp_path, monkeypatch, minimal, minimal_fresh, capsys
):
    """On boxes, with a network of few points."""
    weights = tmp_path / "weights.safetensors"
    config = minimal.config.with_model(poses=3)
    save_weights(weights, config, minimal_fresh, {})

    def box(seed, count):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-1, 1, (count, 3))
        points /= np.abs(points).max(axis=1, keepdims=True)
        return (points * rng.uniform(0.3, 1, 3)).astype(np.float32)

    eye = np.array([2.0, 3.0, 2.5], np.float32)

    class Boxes:
        def __len__(self):
            return 6

        def __getitem__(self, row):
            complete = box(row, 1000)
            partial = complete[complete @ eye > 0]
            return Example(complete, partial, eye, "box", f"{row}")

    def views(name, limit):
        sources = [Boxes()[row] for row in range(6)]
        return [
            View(
                example.partial.astype(np.float64),
                example.complete.astype(np.float64),
                eye.astype(np.float64),
                float(np.ptp(example.complete, axis=0).max()),
                group=number,
            )
            for number, example in enumerate(sources)
        ]

    monkeypatch.setattr(trust, "build_if_missing", lambda *place: None)
    monkeypatch.setattr(trust, "digest_of", lambda *place: "0")
    monkeypatch.setattr(trust, "open_dataset", lambda *place: Boxes())
    monkeypatch.setattr(trust, "validation_views", views)
    output = tmp_path / "trust.json"
    given = (f"--weights={weights}", "--draws=1", f"--output={output}")
    assert launching.run(trust, *given) == 0
    result = json.loads(output.read_text())
    assert result["weights_sha256"] == file_sha256(str(weights))
    assert result["trust"]["all"]["views"] == result["views"] == 12
    Calibration.from_dict(result["calibration"])
    assert "| all | " in capsys.readouterr().out
