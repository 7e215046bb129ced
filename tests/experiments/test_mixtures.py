"""Six trainings' scores side by side."""

import json

import numpy as np
import pytest

from experiments import mixtures
from prism_jax.evaluation.summary import ExampleScores, summarise
from prism_jax.metrics import Scores
from prism_jax.weights import save_weights
from tests import launching


@pytest.fixture
def workdir(tmp_path, minimal, minimal_variables):
    """Two of the trainings, of which the second halves every error."""
    rng = np.random.default_rng(0)
    errors = rng.uniform(1, 2, (12, 2))
    for name, factor in (("today", 1.0), ("poses", 0.5)):
        folder = tmp_path / name
        folder.mkdir()
        weights = folder / "weights.safetensors"
        save_weights(weights, minimal.config, minimal_variables, {"samples": 640})
        rows = [
            ExampleScores(f"{i}", "mug", None, {"partial": four, "completed": one})
            for i, (four, one) in enumerate(
                (Scores(*[4 * a] * 7), Scores(*[factor * b] * 7)) for a, b in errors
            )
        ]
        found = summarise(rows, ["mug"], np.arange(12))
        found |= {"unit": "half a side", "data": "shapes", "split": "novel"}
        for scored in mixtures.SETS:
            (folder / f"{scored}.json").write_text(json.dumps(found))
    return tmp_path


def test_scores_side_by_side(workdir, tmp_path, capsys):
    output = tmp_path / "mixtures.json"
    arguments = [f"--workdir={workdir}", f"--output={output}"]
    assert launching.run(mixtures, *arguments) == 0
    result = json.loads(output.read_text())
    assert list(result["sets"]) == list(mixtures.SETS)
    rows = result["sets"]["shapes-novel"]["rows"]
    assert list(rows) == [*list(mixtures.MIXTURES.values())[:2], "the partial"]
    assert rows["turned and tilted"]["change"]["cd_l2"]["change"] == pytest.approx(-0.5)
    assert rows["turned and tilted"]["samples"] == 640
    text = output.with_suffix(".md").read_text()
    assert text == mixtures.mixtures_markdown(result)
    assert text in capsys.readouterr().out
    tables, last = text.split("Together:")
    assert tables.count("-50.0 %") == len(mixtures.SETS)
    together = result["together"]["rows"]
    assert list(together) == [*mixtures.MIXTURES.values()][:2]
    first, second = together.values()
    assert first["change"] == 0
    assert second["change"] == pytest.approx(-0.5)
    assert second["interval"] == pytest.approx([-0.5, -0.5])
    assert second["mean"] == pytest.approx(first["mean"] / 2)
    assert "-50.0 % [-50.0, -50.0]" in last


def test_other_folders_and_sets(workdir, tmp_path):
    (workdir / "poses").rename(workdir / "mine")
    output = tmp_path / "mine.json"
    arguments = ["--trainings=mine,today", "--sets=shapes-novel"]
    arguments += [f"--workdir={workdir}", f"--output={output}"]
    assert launching.run(mixtures, *arguments) == 0
    sets = json.loads(output.read_text())["sets"]
    assert "together" not in json.loads(output.read_text())
    assert list(sets) == ["shapes-novel"] and sets["shapes-novel"]["against"] == "mine"
    change = sets["shapes-novel"]["rows"][mixtures.MIXTURES["today"]]["change"]
    assert change["cd_l2"]["change"] == pytest.approx(1.0)


def test_another_cloud_of_a_folder(workdir, tmp_path, capsys):
    """All of the partial's scores are four times those of the first."""
    output = tmp_path / "clouds.json"
    arguments = ["--trainings=today,today:partial", f"--output={output}"]
    assert launching.run(mixtures, f"--workdir={workdir}", *arguments) == 0
    for table in json.loads(output.read_text())["sets"].values():
        change = table["rows"]["today, partial"]["change"]["cd_l2"]["change"]
        assert change == pytest.approx(3.0, abs=1.0) and change > 1
    wrong = [f"--workdir={workdir}", "--trainings=today:adapted"]
    assert launching.run(mixtures, *wrong) == 2
    told = capsys.readouterr().err
    assert "unknown value 'adapted'; use one of partial, completed" in told


def test_what_holds_of_all_rows_is_told_of_the_table(workdir, tmp_path):
    """Steps are not, where one row has another number than the first."""
    for name, steps in (("today", 0), ("poses", 1)):
        path = workdir / name / "shapes-novel.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"steps": steps}))
    path = workdir / "poses" / "objects-validation.json"
    for each in (path, workdir / "today" / path.name):
        each.write_text(json.dumps(json.loads(each.read_text()) | {"steps": 0}))
    output = tmp_path / "told.json"
    given = ["--sets=shapes-novel,objects-validation", f"--output={output}"]
    assert launching.run(mixtures, f"--workdir={workdir}", *given) == 0
    mixed, alike = json.loads(output.read_text())["sets"].values()
    assert "steps" not in mixed and mixed["split"] == "novel"
    assert alike["steps"] == 0


def test_step_by_step(workdir, tmp_path):
    """Each against the one before, and the first against the partial."""
    output = tmp_path / "steps.json"
    arguments = ["--trainings=today,poses,today:partial", "--stepwise"]
    arguments += [f"--workdir={workdir}", f"--output={output}"]
    assert launching.run(mixtures, *arguments) == 0
    tables = json.loads(output.read_text())["sets"]
    assert list(tables) == list(mixtures.SETS)
    for table in tables.values():
        rows = table["rows"]
        labels = [mixtures.MIXTURES[name] for name in ("today", "poses")]
        assert list(rows) == ["the partial", *labels, "today, partial"]
        scores = [row["mean"]["cd_l2"] for row in rows.values()]
        for row, before, after in zip(
            [*rows.values()][1:], scores, scores[1:], strict=False
        ):
            change = row["change"]["cd_l2"]["change"]
            assert change == pytest.approx(after / before - 1)
    lines = output.with_suffix(".md").read_text().splitlines()
    assert sum("CD-L2 against the row above" in line for line in lines) == 4
    together = json.loads(output.read_text())["together"]
    assert together["against"] == "the row above"
    found = [row["change"] for row in together["rows"].values()]
    means = [row["mean"] for row in together["rows"].values()]
    assert found == pytest.approx([0, *(np.divide(means[1:], means[:-1]) - 1)])


def test_without_the_first_there_is_nothing_to_compare_with(tmp_path, capsys):
    assert launching.run(mixtures, f"--workdir={tmp_path}") == 2
    assert "today/shapes-novel.json: is missing" in capsys.readouterr().err
