"""What fits verdicts and sigmas, on errors that are known functions of what is seen."""

import dataclasses
import json
from typing import ClassVar

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments import calibrate, robustness
from experiments.calibrate import Points, Scan, from_surface, sigmas, unfitted
from experiments.robustness import View
from prism_jax.completion.weights import file_sha256, save_weights
from prism_jax.data.source import Example
from prism_jax.geometry.workspace import Workspace
from prism_jax.uncertainty.confidence import EVIDENCE, Calibration, Verdict
from prism_jax.uncertainty.sigma import CLUES, PointErrors
from tests import launching
from tests.fake_completer import FakeCompleter

RNG = np.random.default_rng(0)
BLANK = unfitted(RNG.normal(size=(200, 30)) * np.geomspace(1, 1e-3, 30))


@pytest.fixture
def quick(monkeypatch):
    changes = {"n_estimators": 40, "learning_rate": 0.2, "min_samples_leaf": 5}
    monkeypatch.setattr(calibrate, "SIGMA_TREES", calibrate.SIGMA_TREES | changes)
    changes = {"n_estimators": 30, "learning_rate": 0.15}
    monkeypatch.setattr(calibrate, "VERDICT_TREES", calibrate.VERDICT_TREES | changes)


def scans(count, seed):
    """The error grows with the square of what strays, whatever the rest is."""
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        evidence = {name: float(np.exp(rng.normal(-3, 1))) for name in EVIDENCE}
        error = 0.3 * (evidence["strays"] + 1e-3) ** 2 * np.exp(rng.normal(0, 0.1))
        half = float(rng.uniform(0.5, 2))
        name = calibrate.VERDICT_SETS[number % 2]
        made.append(Scan(name, number // 3, "tilt", half, evidence, error * half))
    return made


def test_verdicts_find_a_law_and_are_right_about_others():
    calibration = calibrate.fitted_verdicts(BLANK, scans(600, 0))
    others = scans(400, 2)
    off = [
        np.log(calibration.expected_error(s.evidence) * s.half_extent / s.error)
        for s in others
    ]
    # Errors range over four thousand to one, in steps of the trees.
    assert np.median(np.abs(off)) < 0.25 and np.quantile(np.abs(off), 0.95) < 0.6
    judged = [calibration.judge(scan.evidence, scan.half_extent) for scan in others]
    rows = calibrate.rightness(others, judged)
    assert list(rows) == ["all", "shapes", "roboarm", "tilt"]
    row = rows["all"]
    assert row["views"] == 400 == rows["shapes"]["views"] + rows["roboarm"]["views"]
    assert row["rank_correlation"] > 0.95
    assert row["worst_tenth_low"] > 0.85 and row["better_half_low"] < 0.1
    assert row["error_of_high"] < row["error"] < row["error_of_low"]
    assert row["expected"] == pytest.approx(row["error"], rel=0.15)


def test_no_object_is_judged_by_what_saw_it(quick):
    """What sets one object apart and makes its error is no evidence for itself."""
    others = [s._replace(group=5 * s.group + 1 + s.group % 2) for s in scans(40, 6)]
    usual = scans(1, 7)[0]
    odd = usual._replace(error=1e3 * usual.half_extent)
    verdict = calibrate.judged_unseen(BLANK, [odd, *others])[0]
    assert verdict.expected_error < 0.1 * odd.error
    assert verdict == calibrate.judged_unseen(BLANK, [usual, *others])[0]


def test_what_is_familiar_is_a_spread_away():
    features = RNG.normal(size=(500, 30)) * np.geomspace(1, 1e-2, 30) + 3.0
    found = unfitted(features)
    novelties = np.array([found.novelty(row) for row in features])
    assert np.sqrt((novelties**2).mean()) == pytest.approx(1.0, rel=0.02)
    assert found.novelty(features[0] + 1.0) > 3.0
    assert np.isfinite(unfitted(np.ones((3, 5))).novelty(np.ones(5)))


def points(count, law, each=30):
    """Of so many objects, in turn of each set, with errors about what `law` says."""
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        clues = rng.uniform(size=(each, len(CLUES))).astype(np.float32).astype(float)
        kept = rng.uniform(-1, 1, (each, 3))
        errors = law(clues) * rng.exponential(size=each)
        name, group = list(calibrate.SETS)[number % 4], number // 4
        scan = Scan(name, group, "tilt", float(rng.uniform(0.5, 2)), {}, 0.0)
        made.append(Points(scan, kept, clues, errors, kept, errors))
    return made


def test_sigmas_find_a_law_and_the_mean_is_what_is_expected(quick):
    column = CLUES.index("turned")
    views = points(120, lambda clues: 0.01 + 0.2 * clues[:, column])
    nothing = np.zeros((0, 3)), np.zeros((0, len(CLUES))), np.zeros(0)
    views.append(Points(views[0].scan, *nothing, *views[0][-2:]))
    result = sigmas(views, 30)
    assert result["views"] == {"fitted": 60, "held_out": 60}, "without the empty one"
    row = result["sigma"]["all"]
    assert row["expected"] == pytest.approx(row["error"], rel=0.1)
    # Errors are exponential about the law: so many are below their mean and twice it.
    assert row["below_one"] == pytest.approx(1 - np.exp(-1), abs=0.06)
    assert row["below_two"] == pytest.approx(1 - np.exp(-2), abs=0.08)
    assert json.dumps(result) == json.dumps(sigmas(views, 30)), "the same every time"


def ball(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_the_surface_is_nearer_than_its_sample():
    """Of a ball: where the sample's nearest point alone would be off by ten times."""
    truth, away = ball(8000), np.repeat([0.0, 0.005, -0.02, 0.3], 200)
    found = from_surface(ball(800, seed=1) * (1 + away)[:, None], truth)
    off = np.abs(found - np.abs(away)).reshape(4, 200)
    nearest = KDTree(truth).query(ball(800, seed=1)[:200])[0]
    assert np.median(off[:3]) < 0.1 * nearest.mean()
    assert off[3].max() < 0.01 and (found >= 0).all()
    few = ball(3)
    apart = KDTree(few).query(ball(20, seed=1))[0]
    assert (from_surface(ball(20, seed=1), few) <= apart).all()
    # Beyond a rim the plane is not asked.
    square = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1, 1, 0]
    points = np.array([[1.5, 0, 0], [0, 0, 0.1], [0, 0, 0], [-1.3, 0.2, 0.4]])
    found = from_surface(points, square)
    np.testing.assert_allclose(found, [0.5, 0.1, 0, 0.5], atol=0.02)


class Completer(FakeCompleter):
    """Is told to estimate errors of the points that it adds, by clues of its own."""

    point_errors = calibration = None
    backgrounds: ClassVar[set[str]] = set()

    def __init__(self, config, variables):
        self.config, self.variables = config, variables

    def complete(self, points, camera, up, background):
        self.backgrounds.add(background)
        done = super().complete(points, camera)
        assert self.calibration is not None
        if self.point_errors is not None:
            own = done.workspace.to_unit(done.points[~done.observed])
            self.point_errors.sigma(np.tile(own, (1, len(CLUES)))[:, : len(CLUES)])
        evidence = dict.fromkeys(EVIDENCE, float(np.ptp(points)))
        return dataclasses.replace(done, verdict=Verdict("low", 1.0, (), evidence))


def test_the_command_fits_and_measures(
    quick, tmp_path, monkeypatch, capsys, minimal, minimal_fresh
):
    """On boxes, with a stand-in; errors are distances to the truth."""
    weights, output = tmp_path / "weights.safetensors", tmp_path / "calibration.json"
    eye, noted, measure = np.array([2.0, 3.0, 2.5]), [], calibrate.sigmas

    def views(dataset, split, limit):
        assert split in ("validation", "novel")
        made = []
        for number in range(6):
            rng = np.random.default_rng(number)
            box = rng.uniform(-1, 1, (1000, 3))
            box *= rng.uniform(0.3, 1, 3) / np.abs(box).max(axis=1, keepdims=True)
            size = float(np.ptp(box, axis=0).max())
            made.append(View(box[box @ eye > 0], box, eye, size, group=number))
        return made

    def note(found, count):
        noted.extend(found)
        return measure(found, count)

    def some(name, split):
        assert split == "train"
        clouds = [(v.complete, v.partial) for v in views("", "validation", None)]
        return [Example(*map(np.float32, pair), None, "box", "0") for pair in clouds]

    monkeypatch.setattr(calibrate, "build_if_missing", lambda *place: None)
    monkeypatch.setattr(calibrate, "digest_of", lambda *place: "0")
    monkeypatch.setattr(calibrate, "open_dataset", some)
    monkeypatch.setattr(calibrate, "sigmas", note)
    monkeypatch.setattr(calibrate, "Completer", Completer)
    monkeypatch.setattr(robustness, "views_of", views)
    monkeypatch.setattr(robustness, "any_shift", lambda view, rng: ("none", view))
    given = f"--weights={weights}", "--draws=1", "--points=20", f"--output={output}"
    save_weights(weights, minimal.config, minimal_fresh, {})
    assert launching.run(calibrate, *given) == 2
    said = capsys.readouterr().err
    assert "weights.safetensors: uses fewer than the 3 poses" in said
    save_weights(weights, minimal.config.with_model(poses=3), minimal_fresh, {})
    assert launching.run(calibrate, *given) == 0
    result = json.loads(output.read_text())
    assert result["weights_sha256"] == file_sha256(str(weights))
    assert result["trust"]["all"]["views"] == 12
    assert Completer.backgrounds == {"unknown", "empty"}
    Calibration.from_dict(result["calibration"])
    PointErrors.from_dict(result["point_errors"])
    first, view = noted[0], views("", "validation", None)[0]
    np.testing.assert_array_equal(first.clues[:, :3], first.kept)
    half = first.scan.half_extent * 0.5 * view.size
    workspace = Workspace.from_points(view.partial)
    assert half == pytest.approx(float(workspace.half_extent))
    true = from_surface(workspace.from_unit(first.kept), view.complete) / half
    np.testing.assert_allclose(first.errors, true, atol=1e-6)
