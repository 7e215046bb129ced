"""Shifted views, and what is measured on them, on boxes and a network of few points."""

import dataclasses
import json
import types

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments import robustness, shifts
from experiments.shifts import SHIFTS, View
from prism_jax.completion import Completer
from prism_jax.models.config import ModelConfig
from prism_jax.observation.support import find_up
from tests import launching


def box(count, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    points /= np.abs(points).max(axis=1, keepdims=True)
    return points * [1.0, 0.6, 0.5]


@pytest.fixture(scope="module")
def view():
    complete = box(2000, 0)
    eye = np.array([2.0, 4.0, 3.0])
    return View(box(600, 1)[box(600, 1) @ eye > 0], complete, eye, 2.0)


@pytest.fixture(scope="module")
def completer(minimal, minimal_variables):
    return Completer(minimal.config, minimal_variables)


@pytest.mark.parametrize("name", SHIFTS)
def test_the_truth_follows(view, name):
    """What was measured stays near the true surface, and as large as it was."""
    shifted = SHIFTS[name](view, np.random.default_rng(0))
    gaps = KDTree(shifted.complete).query(shifted.partial)[0]
    assert np.median(gaps) < 0.1
    assert shifted.complete.shape == view.complete.shape
    assert shifted.size == view.size
    distance = np.linalg.norm(shifted.eye - shifted.complete.mean(axis=0))
    before = np.linalg.norm(view.eye - view.complete.mean(axis=0))
    np.testing.assert_allclose(distance, before)
    again = SHIFTS[name](view, np.random.default_rng(0))
    np.testing.assert_array_equal(again.partial, shifted.partial)


def test_each_does_what_its_name_says(view):
    def shifted(name):
        return SHIFTS[name](view, np.random.default_rng(0))

    quarter = shifted("heading 90").partial
    np.testing.assert_allclose(quarter[:, 1], view.partial[:, 0], atol=1e-12)
    for count in (100, 2_000):
        assert len(shifted(f"{count:,} points").partial) == count
    noise = shifted("noise 1 %").partial - view.partial
    assert 0.8 < noise.std() / (0.01 * view.size) < 1.2
    share = len(shifted("cropped by 30 %").partial) / len(view.partial)
    assert abs(share - 0.7) < 0.01


def test_a_tilt_is_undone_by_the_table(view):
    rng = np.random.default_rng(0)
    tilted = SHIFTS["tilt 36, on a table"](view, rng)
    found = find_up(np.concatenate([tilted.partial, tilted.table]), tilted.eye)
    assert found.source == "support"
    assert abs(np.rad2deg(np.arccos(found.vector[2])) - 36) < 2


def test_scores_are_those_of_the_partial_and_of_what_a_user_gets(view, completer):
    scores = robustness.score(view, robustness.completed(completer, view, False).points)
    assert scores["partial"]["prediction_to_truth"] < 0.01
    assert set(scores) == {"partial", "completed"}
    tilted = SHIFTS["tilt 36, on a table"](view, np.random.default_rng(0))
    done = robustness.completed(completer, tilted, adapt=False)
    again = robustness.score(tilted, done.points)
    assert np.isfinite(again["completed"]["cd_l2"])


def test_what_is_said_of_the_background_is_passed_on(view, completer, monkeypatch):
    asked, plain = [], completer.complete

    def complete(*given, **settings):
        asked.append(settings["background"])
        return plain(*given, **settings)

    monkeypatch.setattr(completer, "complete", complete)
    robustness.completed(completer, view, False)
    robustness.completed(completer, view, False, "empty")
    assert asked == ["unknown", "empty"]


def test_the_table_has_a_row_for_each_shift(view, completer):
    done = robustness.completed(completer, view, adapt=False)
    scores = [robustness.score(view, done.points)]
    row = {"views": 1, "commit": None, **robustness._summary(scores)}
    about = {"weights": "w", "data": "boxes", "shifts": {"heading 0": row}}
    text = robustness.robustness_markdown(about)
    shown = 1e4 * scores[0]["completed"]["cd_l2"]
    assert "| heading 0 | 1 | " in text and f"{shown:.4g}" in text


def test_shifts_are_added_to_those_of_the_same_weights(view, tmp_path, monkeypatch):
    """Each is written as soon as it is done."""
    completers = []
    monkeypatch.setattr(
        robustness.Completer, "from_pretrained", lambda path: completers[-1]
    )
    monkeypatch.setattr(
        robustness, "_views", lambda: ([view], {"data": "boxes", "digest": "d"})
    )
    backgrounds = []

    def completed(completer, view, adapt, background):
        backgrounds.append(background)
        return view_as_it_is(view)

    monkeypatch.setattr(robustness, "completed", completed)
    output = tmp_path / "robustness.json"

    def run(number, *shifts, more=()):
        completer = types.SimpleNamespace(
            variables={"x": np.full(3, number)}, config=ModelConfig()
        )
        completers.append(completer)
        given = [f"--shift={shift}" for shift in shifts] + list(more)
        assert launching.run(robustness, f"--output={output}", *given) == 0
        return list(json.loads(output.read_text())["shifts"])

    assert run(0.0, "noise 1 %") == ["noise 1 %"]
    assert run(0.0, "heading 0") == ["heading 0", "noise 1 %"]
    assert run(0.0, "heading 0") == ["heading 0", "noise 1 %"]
    assert run(1.0, "heading 45") == ["heading 45"], "of other weights"
    more = ["--set=poses=2"]
    assert run(1.0, "noise 1 %", more=more) == ["noise 1 %"], "of other settings"
    assert completers[-1].config.poses == 2
    assert run(1.0, "heading 45", more=more) == ["heading 45", "noise 1 %"]
    assert "`small`, poses=2, commit" in output.with_suffix(".md").read_text()
    assert run(1.0, "heading 0") == ["heading 0"], "of the weights' own settings"
    assert run(1.0, "noise 1 %", more=["--background=empty"]) == ["noise 1 %"]
    assert set(backgrounds[:-1]) == {"unknown"} and backgrounds[-1] == "empty"
    assert "`small`, background empty, commit" in output.with_suffix(".md").read_text()


def view_as_it_is(view):
    return types.SimpleNamespace(points=view.partial)


def test_views_are_of_the_validation_split(monkeypatch, view):
    asked = []

    class Few:
        objects = np.arange(9) // 2

        def __len__(self):
            return 9

        def __getitem__(self, row):
            asked.append(row)
            return row

    monkeypatch.setattr(shifts, "open_dataset", lambda *place: Few())
    monkeypatch.setattr(shifts, "with_partial", lambda row: dataclasses.replace(view))
    views = shifts.validation_views("shapes", 3)
    assert asked == [0, 4, 8]
    assert [one.group for one in views] == [0, 2, 4]


def test_any_shift_is_one_of_every_kind_and_the_same_again(view):
    kinds = {}
    for seed in range(40):
        kind, shifted = shifts.any_shift(view, np.random.default_rng(seed))
        _, again = shifts.any_shift(view, np.random.default_rng(seed))
        np.testing.assert_array_equal(shifted.partial, again.partial)
        assert not np.array_equal(shifted.complete, view.complete)
        kinds.setdefault(kind, []).append(shifted)
    assert set(kinds) == {"heading", "tilt", "points", "noise", "crop"}
    assert all(one.table is not None for one in kinds["tilt"])
    assert all(len(one.partial) < len(view.partial) for one in kinds["crop"])
