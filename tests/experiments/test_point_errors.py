"""What fits points' errors, on errors that are known functions of the clues."""

import json

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments import point_errors
from experiments.point_errors import (
    SETS,
    Sample,
    fitted_and_measured,
    from_surface,
)
from experiments.shifts import View
from prism_jax.point_errors import CLUES, PointErrors
from prism_jax.weights import file_sha256, save_weights
from tests import launching

COUNT = len(CLUES)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    changes = {"n_estimators": 40, "learning_rate": 0.2, "min_samples_leaf": 5}
    monkeypatch.setattr(point_errors, "TREES", point_errors.TREES | changes)


def samples(count, law, points=30):
    """Of so many objects, in turn of each set, with errors about what `law` says."""
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        clues = rng.uniform(size=(points, COUNT)).astype(np.float32).astype(float)
        kept = rng.uniform(-1, 1, (points, 3))
        errors = law(clues) * rng.exponential(size=points)
        name = list(SETS)[number % len(SETS)]
        unit = float(rng.uniform(0.5, 2))
        group = number // len(SETS)
        places = kept, clues, errors, kept, errors
        made.append(Sample(name, group, "tilt", unit, *places))
    return made


def test_a_law_is_found_and_the_mean_is_what_is_expected():
    column = CLUES.index("turned")
    views = samples(120, lambda clues: 0.01 + 0.2 * clues[:, column])
    result = fitted_and_measured(views, 30)
    assert result["views"] == {"fitted": 60, "held_out": 60}
    everything = result["sigma"]["all"]
    assert everything["points"] == 60 * 30 and set(result["left_out"]) == set(SETS)
    assert everything["expected"] == pytest.approx(everything["error"], rel=0.1)
    # Errors are exponential about the law: so many are below their mean and twice it.
    assert everything["below_one"] == pytest.approx(1 - np.exp(-1), abs=0.06)
    assert everything["below_two"] == pytest.approx(1 - np.exp(-2), abs=0.08)
    tenths = [row["error"] for row in result["deciles"]]
    assert tenths[-1] > 4 * tenths[0]
    assert max(result["alone"], key=lambda name: abs(result["alone"][name])) == "turned"
    text = point_errors.point_errors_markdown(
        {"weights": "w", "commit": None, **result}
    )
    assert "| all | 1,800 |" in text and "turned 0." in text


def test_it_finds_nothing_where_nothing_is():
    result = fitted_and_measured(
        samples(80, lambda clues: np.full(len(clues), 0.1)), 30
    )
    assert abs(result["sigma"]["all"]["within_views"]) < 0.15


def test_the_same_samples_give_the_same_fit():
    views = samples(40, lambda clues: clues[:, 3])
    first, second = (fitted_and_measured(views, 20)["point_errors"] for _ in range(2))
    assert json.dumps(first) == json.dumps(second)


def test_a_view_to_which_nothing_is_added_is_left_out():
    views = samples(16, lambda clues: clues[:, 3])
    nothing = (np.zeros((0, 3)), np.zeros((0, COUNT)), np.zeros(0)) + 2 * (np.zeros(0),)
    views.append(Sample("shapes", 0, "crop", 1.0, *nothing))
    assert fitted_and_measured(views, 30)["views"] == {"fitted": 8, "held_out": 8}


def test_the_command_fits_and_measures(
    tmp_path, monkeypatch, minimal, minimal_fresh, capsys
):
    """On boxes, with a network of few points; errors are distances to the truth."""
    weights = tmp_path / "weights.safetensors"
    config = minimal.config.with_model(poses=3)
    save_weights(weights, config, minimal_fresh, {})
    eye, noted = np.array([2.0, 3.0, 2.5]), []

    def views(name, limit, split):
        made = []
        for number in range(10):
            rng = np.random.default_rng(number)
            box = rng.uniform(-1, 1, (1000, 3))
            box /= np.abs(box).max(axis=1, keepdims=True)
            box *= rng.uniform(0.3, 1, 3)
            size = float(np.ptp(box, axis=0).max())
            made.append(View(box[box @ eye > 0], box, eye, size, group=number))
        return made

    measure = fitted_and_measured

    def note(found, count):
        noted.extend(found)
        return measure(found, count)

    monkeypatch.setattr(point_errors, "build_if_missing", lambda *place: None)
    monkeypatch.setattr(point_errors, "digest_of", lambda *place: "0")
    monkeypatch.setattr(point_errors, "validation_views", views)
    monkeypatch.setattr(point_errors, "any_shift", lambda view, rng: ("none", view))
    monkeypatch.setattr(point_errors, "fitted_and_measured", note)
    output = tmp_path / "point_errors.json"
    given = (f"--weights={weights}", "--points=20", f"--output={output}")
    assert launching.run(point_errors, *given) == 0
    result = json.loads(output.read_text())
    assert result["weights_sha256"] == file_sha256(str(weights))
    assert sum(result["views"].values()) == len([one for one in noted if len(one.kept)])
    PointErrors.from_dict(result["point_errors"])
    assert "| novel, fitted without | " in capsys.readouterr().out
    first, view = noted[0], views("", 0, "")[0]
    assert first.clues.shape == (len(first.kept), COUNT)
    # Of one view in two sets, turned by nothing, the same is said.
    again = noted[10]
    np.testing.assert_array_equal(first.kept, again.kept)
    np.testing.assert_array_equal(first.clues, again.clues)
    half = first.unit * 0.5 * view.size
    spans = np.ptp(view.partial, axis=0)
    middle = 0.5 * (view.partial.min(axis=0) + view.partial.max(axis=0))
    assert half == pytest.approx(0.5 * minimal.model.margin * spans.max())
    true = from_surface(first.kept * half + middle, view.complete) / half
    np.testing.assert_allclose(first.errors, true, atol=1e-9)


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


def test_beyond_a_rim_the_plane_is_not_asked():
    square = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1, 1, 0]
    points = np.array([[1.5, 0, 0], [0, 0, 0.1], [0, 0, 0], [-1.3, 0.2, 0.4]])
    found = from_surface(points, square)
    np.testing.assert_allclose(found, [0.5, 0.1, 0, 0.5], atol=0.02)
    assert found[1] == pytest.approx(0.1, abs=1e-12)


def test_a_truth_of_few_points():
    few = ball(3)
    apart = KDTree(few).query(ball(20, seed=1))[0]
    assert (from_surface(ball(20, seed=1), few) <= apart).all()
    assert from_surface(few, np.ones((1, 3)) * few[0])[0] == 0
