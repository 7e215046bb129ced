"""Shifted views, and what is measured on them, on boxes and with a fake completer."""

import json

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments import robustness
from experiments.robustness import SHIFTS, View
from prism_jax.evaluation import metrics
from tests import launching
from tests.fake_completer import FakeCompleter


def box(count, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    points /= np.abs(points).max(axis=1, keepdims=True)
    return points * [1.0, 0.6, 0.5]


@pytest.fixture(scope="module")
def view():
    eye = np.array([2.0, 4.0, 3.0])
    return View(box(600, 1)[box(600, 1) @ eye > 0], box(2000, 0), eye, 2.0)


SOME = ["heading 45", "tilt 36, on a table", "500 points", "20,000 points", "noise 2 %"]


@pytest.mark.parametrize("name", [*SOME, "cropped by 50 %"])
def test_the_truth_follows(view, name):
    """What was measured stays near the true surface, and as large as it was."""
    shifted = SHIFTS[name](view, np.random.default_rng(0))
    assert np.median(KDTree(shifted.complete).query(shifted.partial)[0]) < 0.1
    assert shifted.complete.shape == view.complete.shape
    assert shifted.size == view.size
    distance = np.linalg.norm(shifted.eye - shifted.complete.mean(axis=0))
    before = np.linalg.norm(view.eye - view.complete.mean(axis=0))
    np.testing.assert_allclose(distance, before)


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


def test_any_shift_is_one_of_every_kind_and_views_are_evenly_spaced(monkeypatch, view):
    kinds = {}
    for seed in range(40):
        kind, shifted = robustness.any_shift(view, np.random.default_rng(seed))
        assert not np.array_equal(shifted.complete, view.complete)
        kinds.setdefault(kind, []).append(shifted)
    assert set(kinds) == {"heading", "tilt", "points", "noise", "crop"}
    assert all(one.table is not None for one in kinds["tilt"])

    class Rows(list):
        objects = np.arange(9) // 2

    monkeypatch.setattr(robustness, "open_dataset", lambda *place: Rows(range(9)))
    monkeypatch.setattr(robustness, "build_if_missing", lambda *place: None)
    monkeypatch.setattr(robustness, "with_partial", lambda row: view)
    found = [one.group for one in robustness.views_of("shapes", "validation", 3)]
    assert found == [0, 2, 4]


def test_the_command_scores_what_a_user_gets(view, tmp_path, monkeypatch, capsys):
    ups = []

    class Completer(FakeCompleter):
        def __init__(self):
            self.variables = {"x": np.zeros(3)}

        def complete(self, points, camera, up):
            ups.append(up)
            return super().complete(points, camera)

    monkeypatch.setattr(robustness.Completer, "from_pretrained", lambda _: Completer())
    monkeypatch.setattr(robustness, "views_of", lambda *place: [view, view])
    monkeypatch.setattr(robustness, "digest_of", lambda *place: "0")
    output, shifts = tmp_path / "robustness.json", ["tilt 36, on a table", "heading 0"]
    given = [f"--shift={name}" for name in shifts]
    assert launching.run(robustness, f"--output={output}", *given) == 0
    rows = json.loads(output.read_text())["shifts"]
    assert list(rows) == shifts
    # The way up is the table's, or z.
    assert abs(np.rad2deg(np.arccos(ups[0][2])) - 36) < 2 and ups[2:] == ["z", "z"]
    done = FakeCompleter().complete(view.partial)
    row, unit = rows["heading 0"], 0.5 * view.size
    for name, cloud in {"partial": view.partial, "completed": done.points}.items():
        wanted = metrics.score(cloud / unit, view.complete / unit).cd_l2
        assert row[name]["CD-L2 x1e4"] == pytest.approx(1e4 * wanted, rel=1e-4)
        assert row[name]["CD-L2 x1e4"] == pytest.approx(row[name]["median"])
    assert (
        f"| heading 0 | {row['completed']['CD-L2 x1e4']:.4g} |"
        in capsys.readouterr().out
    )
    assert launching.run(robustness, "--shift=upside down") == 2
