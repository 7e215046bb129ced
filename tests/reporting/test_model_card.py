"""What weights say of themselves, beside what their file holds and the README shows."""

import json
import pathlib

import pytest

from experiments.simulation.roboarm.models import arms_of
from prism_jax.completion.weights import read_metadata, save_weights
from prism_jax.evaluation.tables import markdown
from prism_jax.reporting.model_card import model_card, weights_table

README = pathlib.Path(__file__).resolve().parents[2] / "README.md"


@pytest.fixture
def told_of(tmp_path, minimal, minimal_variables):
    """A file of weights about which this is known."""

    def written(name="weights", **about) -> str:
        path = tmp_path / f"{name}.safetensors"
        save_weights(path, minimal.config, minimal_variables, about)
        return str(path)

    return written


def test_all_that_ship_have_one():
    card, about = model_card("small"), read_metadata("small")
    assert card.startswith("# small\n")
    assert about["notes"] and "experiments.md" not in card
    for note in about["notes"]:
        assert note.replace("experiments.md", "findings.md") in card
    assert "512 points in, 6,144 out, of 3 poses" in card
    assert "meshes of shapes: procedural" in card
    for result in about["scores"].values():
        completed = result["clouds"]["completed"]
        low, high = (1e4 * bound for bound in completed["intervals"]["cd_l2"])
        mean = 1e4 * completed["mean"]["cd_l2"]
        assert f"| completed | {mean:.4g} [{low:.4g}, {high:.4g}]" in card


def test_the_table_has_what_users_get_of_each_split(told_of):
    path = README.parent / "docs" / "tables" / "unseen.json"
    result = json.loads(path.read_text())
    about = {"samples": 1200, "scores": {"shapes-unseen": result}}
    paths = [told_of("scored", **about), told_of("blank")]
    head, scored, blank = weights_table(paths).splitlines()
    assert head.split()[:2] == ["weights", "samples"]
    got = result["clouds"]["completed_unadapted"]
    errors = (result["clouds"]["partial"], got)
    told = [f"{1e4 * cloud['mean']['cd_l2']:.4g}" for cloud in errors]
    kinds = got["per_category"]
    worst = max(kinds, key=lambda kind: kinds[kind]["cd_l2"])
    assert scored.split()[1:] == ["1,200", "shapes-unseen", *told, worst]
    assert blank.split()[1:] == ["0", "nothing"]


@pytest.mark.parametrize(
    ("name", "split"),
    [("test", "shapes-test"), ("unseen", "shapes-unseen"), ("robots", "roboarm-test")],
)
def test_scores_that_they_ship_with_are_shown(name, split):
    released = read_metadata("small")["scores"][split]
    path = README.parent / "docs" / "tables" / f"{name}.json"
    tables = markdown(released), markdown(json.loads(path.read_text()))
    lines, stored = ({s for s in text.splitlines() if "[" in s} for text in tables)
    assert len(lines) >= 5 and lines <= stored
    found = released["clouds"]["completed_unadapted"]
    low, high = (1e4 * bound for bound in found["intervals"]["cd_l2"])
    shown = (README.parent / "docs" / "results.md").read_text()
    assert f"{1e4 * found['mean']['cd_l2']:.4g} [{low:.4g}, {high:.4g}]" in shown


def test_every_training_counts(told_of):
    first = {"samples": 1000, "data": "shapes", "preset": "small", "commit": "a" * 40}
    second = {"samples": 200, "data": "roboarm, shapes", "pretrained": first}
    second["interpolated"] = {"share": 0.6}
    card = model_card(told_of(samples=30, data="roboarm", seed=4, pretrained=second))
    lines = [line[2:] for line in card.splitlines() if line.startswith("- ")]
    of_first = f"1,000 samples of shapes, preset small, seed None, commit {'a' * 12}"
    assert lines[0] == of_first
    assert lines[1].startswith("200 samples of roboarm, shapes")
    assert lines[1].endswith(", 60% of what it changed kept")
    assert lines[2].startswith("30 samples of roboarm, preset None, seed 4")
    assert lines[3] == "1,230 samples in all" and "kept" not in lines[2]
    parts = [line.split(":")[0] for line in lines[4:]]
    assert parts == ["meshes of shapes", "meshes of roboarm"]
    for arm in arms_of("train"):
        assert f"{arm.name} {arm.licence}" in lines[5]
    assert "No scores." in card
    assert "0 samples in all" in model_card(told_of())
