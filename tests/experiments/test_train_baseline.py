"""The launcher of networks to compare with, on what it shares with `train`."""

import json

import pytest

from experiments import train, train_baseline
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
    """``run(launcher, flags)``: the exit status, with a PCN of the size of `tiny`."""
    monkeypatch.setitem(NETWORKS["pcn"], "tiny", PCN(TINY))
    given = ["--preset=tiny", f"--data_dir={few_shapes}"]
    return lambda launcher, *flags: launching.run(launcher, *given, *flags)


def begun(folder):
    return json.loads((folder / "config.json").read_text())["config"]


@pytest.mark.slow
def test_it_trains_on_a_mixture_as_pretraining_does(run, tmp_path, monkeypatch):
    own, other = tmp_path / "baseline", tmp_path / "pretrained"
    mixture = ("--mixture=shapes:2", "--whole=0.25")
    flags = *mixture, f"--workdir={own}", "--network=pcn", "--samples=16"
    assert run(train_baseline, *flags) == 0
    path = str(own / "weights.safetensors")
    metadata = read_metadata(path)
    assert metadata["network"] == "pcn" and metadata["samples"] == 16
    assert load_network(path)[0].config == TINY
    monkeypatch.setattr(train, "pretrain", lambda *_: None)
    assert run(train, *mixture, f"--workdir={other}") == 0
    assert begun(own)["data"] == begun(other)["data"]
    assert begun(own)["data"]["mixture"] == {"shapes": 2.0}
    assert begun(own)["data"]["whole"] == 0.25


def test_as_many_samples_as_the_presets_own(run, tmp_path, monkeypatch, capsys):
    """Of both phases and the meta-training."""

    def stopped(phase, data, folder, *_):
        return Trained(phase.start.variables, phase.start, False)

    monkeypatch.setattr(train_baseline, "train_phase", stopped)
    assert run(train_baseline, f"--workdir={tmp_path}", "--network=pcn") == 0
    assert "stopped; resume with" in capsys.readouterr().out
    assert begun(tmp_path)["samples"] == 64 + 64 + 128
    assert begun(tmp_path)["data"]["dataset"] == "shapes"
    flags = f"--workdir={tmp_path / 'run'}", "--network=fsc"
    assert run(train_baseline, *flags) == 2
    assert "fsc has no preset tiny" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
