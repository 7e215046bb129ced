"""What weights say of themselves, beside what their file holds and the README shows."""

import pathlib

import pytest

from prism_jax.data.datasets import parts_of
from prism_jax.evaluation import markdown
from prism_jax.io import InputError
from prism_jax.model_card import model_card
from prism_jax.simulation.roboarm.models import arms_of
from prism_jax.weights import available_weights, read_metadata, save_weights

README = pathlib.Path(__file__).resolve().parents[1] / "README.md"


@pytest.fixture
def card_of(tmp_path, minimal, minimal_variables):
    """The card of weights about which this is known."""

    def card(**about) -> str:
        path = tmp_path / "weights.safetensors"
        save_weights(path, minimal.config, minimal_variables, about)
        return model_card(str(path))

    return card


@pytest.mark.parametrize("name", available_weights())
def test_all_that_ship_have_one(name):
    card, about = model_card(name), read_metadata(name)
    assert card.startswith(f"# {name}\n")
    assert all(note in card for note in about["notes"])
    assert "512 points in, 2,048 out" in card
    assert "meshes of shapes: procedural" in card
    for result in about.get("scores", {}).values():
        low, high = (1e4 * bound for bound in result["merged"]["intervals"]["cd_l2"])
        mean = 1e4 * result["merged"]["mean"]["cd_l2"]
        assert f"{mean:.4g} [{low:.4g}, {high:.4g}]" in card
        kinds = result["merged"]["per_category"]
        worst = max(kinds, key=lambda kind: kinds[kind]["cd_l2"])
        assert f"with the measured points kept: {worst} (" in card


@pytest.mark.parametrize("name", ["small", "small-robocell"])
def test_what_they_ship_with_of_the_test_splits_is_shown(name):
    scores = read_metadata(name)["scores"]
    shown = README.read_text() + README.with_name("BUILD_NOTES.md").read_text()
    splits = [split for split in scores if "validation" not in split]
    assert splits
    for split in splits:
        lines = [line for line in markdown(scores[split]).splitlines() if "[" in line]
        assert len(lines) == 5
        assert not [line for line in lines if line not in shown]


def test_every_training_counts(card_of):
    first = {"samples": 1000, "data": "shapes", "preset": "small", "commit": "a" * 40}
    second = {"samples": 200, "data": "roboarm, shapes", "pretrained": first}
    card = card_of(samples=30, data="roboarm", seed=4, pretrained=second)
    lines = [line[2:] for line in card.splitlines() if line.startswith("- ")]
    assert (
        lines[0]
        == f"1,000 samples of shapes, preset small, seed None, commit {'a' * 12}"
    )
    assert lines[1].startswith("200 samples of roboarm, shapes")
    assert lines[2].startswith("30 samples of roboarm, preset None, seed 4")
    assert lines[3] == "1,230 samples in all"
    assert [line.split(":")[0] for line in lines[4:]] == [
        "meshes of shapes",
        "meshes of roboarm",
    ]
    for arm in arms_of("train"):
        assert f"{arm.name} {arm.licence}" in lines[5]
    assert "No scores." in card


def test_without_a_word_of_training(card_of):
    assert "0 samples in all" in card_of()


def test_what_is_not_weights_has_none():
    with pytest.raises(InputError, match="no such weights"):
        model_card("huge")


def test_a_set_is_its_own_part():
    assert parts_of("shapes") == ["shapes"]
