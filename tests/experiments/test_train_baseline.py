"""The launcher of networks to compare with, on what it shares with `pretrain`."""

import json

import pytest

from experiments import pretrain, train_baseline
from experiments.baselines.networks import NETWORKS
from experiments.baselines.pcn import PCN, PCNConfig
from experiments.baselines.weights import load_network
from prism_jax.training.phase import Trained
from prism_jax.weights import read_metadata
from tests import launching

TINY = PCNConfig(
    64, (4, 8), (8, 8), (8,), num_coarse=16, fold_features=(8,), grid_size=2
)
MIXTURE = ("--mixture=shapes:2", "--whole=0.25")


@pytest.fixture
def given(few_shapes, monkeypatch):
    monkeypatch.setitem(NETWORKS["pcn"], "tiny", PCN(TINY))
    return ["--preset=tiny", f"--data_dir={few_shapes}"]


@pytest.mark.slow
def test_it_trains_on_a_mixture_as_pretraining_does(given, tmp_path, monkeypatch):
    workdir = tmp_path / "baseline"
    flags = [*given, *MIXTURE, f"--workdir={workdir}", "--network=pcn", "--samples=16"]
    assert launching.run(train_baseline, *flags) == 0
    begun = json.loads((workdir / "config.json").read_text())["config"]
    assert begun["data"]["mixture"] == {"shapes": 2.0}
    assert begun["data"]["whole"] == 0.25
    assert begun["samples"] == 16

    metadata = read_metadata(str(workdir / "weights.safetensors"))
    assert metadata["network"] == "pcn" and metadata["samples"] == 16
    module, _ = load_network(str(workdir / "weights.safetensors"))
    assert module.config == TINY
    monkeypatch.setattr(pretrain, "pretrain", lambda *_: None)
    other = tmp_path / "pretrained"
    assert launching.run(pretrain, *given, *MIXTURE, f"--workdir={other}") == 0
    same = json.loads((other / "config.json").read_text())["config"]
    assert same["data"] == begun["data"]


def test_as_many_samples_as_the_presets_own(given, tmp_path, monkeypatch, capsys):
    """Of both phases and the meta-training."""
    phases = []

    def stopped(phase, data, folder, *_):
        phases.append(phase)
        return Trained(phase.start.variables, phase.start, False)

    monkeypatch.setattr(train_baseline, "train_phase", stopped)
    flags = [*given, f"--workdir={tmp_path}", "--network=pcn"]
    assert launching.run(train_baseline, *flags) == 0
    assert [phase.num_samples for phase in phases] == [64 + 64 + 128]
    assert "stopped; go on with" in capsys.readouterr().out
    begun = json.loads((tmp_path / "config.json").read_text())["config"]
    assert begun["samples"] == 64 + 64 + 128
    assert begun["data"]["dataset"] == "shapes"


def test_a_preset_without_a_network_of_its_size_is_refused(given, tmp_path, capsys):
    flags = [*given, f"--workdir={tmp_path / 'run'}", "--network=snowflakenet"]
    assert launching.run(train_baseline, *flags) == 2
    assert "snowflakenet has no size for tiny" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
