"""The launcher of networks to compare with, on what it shares with `train`."""

import json

import pytest

from experiments import train_baseline
from experiments.baselines.networks import NETWORKS
from experiments.baselines.pcn import PCN, PCNConfig
from experiments.baselines.weights import load_network
from prism_jax.completion.weights import read_metadata
from prism_jax.training.phase import Trained
from tests import launching

TINY = PCNConfig(
    64, (4, 8), (8, 8), (8,), num_coarse=16, fold_features=(8,), grid_size=2
)


@pytest.fixture
def run(few_shapes, monkeypatch):
    """``run(flags)``: the exit status, with a PCN of the size of `tiny`."""
    monkeypatch.setitem(NETWORKS["pcn"], "tiny", PCN(TINY))
    given = ["--preset=tiny", f"--data_dir={few_shapes}"]
    return lambda *flags: launching.run(train_baseline, *given, *flags)


@pytest.mark.parametrize("done", [False, True])
def test_what_is_trained_and_on_how_much(run, tmp_path, monkeypatch, capsys, done):
    """By itself as many samples as both phases and the meta-training of the preset."""

    def train_phase(phase, data, folder, *_):
        return Trained(phase.start.variables, phase.start, done)

    monkeypatch.setattr(train_baseline, "train_phase", train_phase)
    flags = ["--mixture=shapes:2", "--samples=16"] if done else []
    assert run(f"--workdir={tmp_path}", "--network=pcn", *flags) == 0
    begun = json.loads((tmp_path / "config.json").read_text())["config"]
    data, path = begun["data"], tmp_path / "weights.safetensors"
    assert begun["samples"] == (16 if done else 64 + 64 + 128)
    if done:
        assert data["mixture"] == {"shapes": 2.0}
        metadata = read_metadata(str(path))
        assert metadata["network"] == "pcn" and metadata["samples"] == 16
        assert load_network(str(path))[0].config == TINY
    else:
        assert data["mixture"] == {"shapes": 1.0} and not path.exists()
        assert "stopped; resume with" in capsys.readouterr().out


def test_a_network_without_the_preset_is_refused(run, tmp_path, capsys):
    assert run(f"--workdir={tmp_path / 'run'}", "--network=fsc") == 2
    assert "fsc has no preset tiny" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
