"""The launchers: what is written, and when nothing is. Training is a fake."""

import json

import numpy as np
import pytest

from experiments import adapt_plant, plant
from experiments.assets import CELLS
from experiments.plants.check import Evidence
from experiments.plants.training import Adapted
from prism_jax.evaluation.run import Predictions
from prism_jax.model_card import model_card
from prism_jax.weights import load_pretrained, read_metadata, sha256
from tests import launching

HIDDEN = np.linspace(0.1, 0.2, 10)


def trained(factor):
    """A training that leaves the variables, and the hidden so many times as far."""
    seen = {}

    def adapt(config, variables, source, settings, seed, steps, minutes):
        seen.update(source=source, settings=settings, steps=steps, minutes=minutes)
        before, after = (
            Evidence(np.arange(10), each, each, np.zeros(10))
            for each in (HIDDEN, factor * HIDDEN)
        )
        return Adapted(variables, steps or 7, len(source), 20, before, after)

    return adapt, seen


def run(command, factor, minimal, variables, *arguments):
    """The exit status, and what the training was given."""
    adapt, seen = trained(factor)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "adapt", adapt)
        load = lambda name: (minimal.config, variables)  # noqa: E731
        patch.setattr(command, "load_pretrained", load)
        return launching.run(command, *arguments), seen


@pytest.fixture
def adapted(minimal, minimal_fresh):
    def adapted(factor, *arguments):
        given = (minimal, minimal_fresh, f"--recordings={CELLS}", *arguments)
        return run(adapt_plant, factor, *given)

    return adapted


def test_weights_are_written_with_where_they_come_from(
    adapted, tmp_path, minimal_fresh, minimal
):
    output = tmp_path / "mine.safetensors"
    given = ("--frames=12", "--steps=5", "--set=moves=decoder", "--seed=3")
    status, seen = adapted(0.8, f"--output={output}", *given)
    assert status == 0
    assert (seen["steps"], seen["minutes"]) == (5, None)
    assert seen["settings"].moves == "decoder"
    assert len(seen["source"]) == 12 and seen["source"][0].complete is None
    config, variables = load_pretrained(str(output))
    assert config == minimal.config
    assert sha256(variables) == sha256(minimal_fresh)
    about = read_metadata(str(output))
    assert (about["data"], about["seed"], about["samples"]) == ("recordings", 3, 40)
    assert about["pretrained"]["preset"] == "small"
    origin = about["adapted"]
    assert (origin["from"], origin["frames"], origin["steps"]) == ("small", 12, 5)
    assert origin["sequences"] == 20 and len(origin["sha256"]) == 64
    assert np.isclose(origin["check"]["change"], -0.2)
    assert "calibration" not in about
    card = model_card(str(output))
    assert "Adapted without labels from small. 5 steps on 12 frames" in card
    assert "40 samples of recordings" in card


def test_what_is_no_better_is_not_written(adapted, tmp_path, capsys):
    output = tmp_path / "mine.safetensors"
    status, seen = adapted(1.0, f"--output={output}")
    assert status == 1
    assert (seen["steps"], seen["minutes"]) == (None, 15.0)
    assert not [*tmp_path.iterdir()]
    error = capsys.readouterr().err
    assert error.startswith("adapt_plant: not written: held-out frames")
    assert error.count("\n") == 1


def test_two_sources_and_none_are_refused(minimal, minimal_fresh, tmp_path, capsys):
    output = f"--output={tmp_path / 'mine.safetensors'}"
    for given in ([], [f"--recordings={CELLS}", "--dataset=roboarm"]):
        status, _ = run(adapt_plant, 0.8, minimal, minimal_fresh, output, *given)
        assert status == 2
        error = capsys.readouterr().err
        assert "one of them, is needed" in error and error.count("\n") == 1


def test_other_sequences_are_scored(minimal, minimal_fresh, tmp_path, capsys):
    """The fake network returns the partial, and so do both rows."""
    output = tmp_path / "plant.json"
    with pytest.MonkeyPatch.context() as patch:
        fake = lambda *_: lambda partials, eyes: Predictions(partials)  # noqa: E731
        patch.setattr(plant, "prism_completer", fake)
        status, seen = run(
            plant,
            0.8,
            minimal,
            minimal_fresh,
            "--dataset=recordings",
            f"--data_dir={CELLS}",
            "--split=all",
            "--limit=3",
            f"--output={output}",
        )
    assert status == 0
    trained_on = {seen["source"][i].name for i in range(len(seen["source"]))}
    result = json.loads(output.read_text())
    network = result["clouds"]["network"]
    assert network["num_examples"] == 3
    assert network["rows"]["adapted"]["change"]["truth_to_prediction"]["change"] == 0
    assert len(trained_on) == 13
    assert (result["passed"], result["frames"], result["sequences"]) == (True, 13, 20)
    table = capsys.readouterr().out
    assert "7 steps on 13 frames" in table and "It passed." in table
    assert "| network, truth to prediction | +0.0 % [+0.0, +0.0]" in table
    assert "| completed, CD-L2 |" in table
