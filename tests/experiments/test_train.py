"""The launcher of both phases: what it starts from, writes, and resumes.

Pretraining is a stand-in (`tests/training/test_pretraining.py` has the real one). Of
meta-training the networks are; variables, data, optimisers and checkpoints are real.
"""

import dataclasses
import json

import jax
import numpy as np
import pytest

from experiments import train
from prism_jax.completion.weights import (
    load_pretrained,
    read_metadata,
    save_weights,
    sha256,
)
from prism_jax.models.variables import ENCODERS
from tests import launching, stand_in_networks
from tests.trees import bitwise, equal

NETWORK = ["num_neighbors=(4,)", "encoder_rates=(1,)"]
NETWORK += ["level_rates=((1,),)", "up_factors=(2,)"]
META = {"num_samples": 8, "batch_size": 2, "validate_every": 4, "learning_rate": 0.1}
SMALL = [f"--set=model.backbone.{change}" for change in NETWORK]
CHANGES = [*SMALL, *(f"--set=meta.{name}={value}" for name, value in META.items())]
SAMPLES = [f"--set=pretrain.backbone.{i}.num_samples={n}" for i, n in [(0, 0), (1, 32)]]
BEFORE = {"preset": "tiny", "seed": 5, "commit": None, "data": "shapes", "samples": 64}


@pytest.fixture(scope="module")
def weights(tmp_path_factory, minimal, minimal_variables):
    path = tmp_path_factory.mktemp("weights") / "before.safetensors"
    save_weights(path, minimal.config, minimal_variables, BEFORE | {"scores": {"a": 1}})
    return path


@pytest.fixture(scope="module")
def others(weights, minimal, minimal_variables):
    """Weights of the same network, of other numbers."""
    path = weights.with_name("others.safetensors")
    params = jax.tree.map(np.negative, minimal_variables["params"])
    save_weights(path, minimal.config, {**minimal_variables, "params": params}, BEFORE)
    return path


def known(path):
    metadata = read_metadata(str(path))
    return {key: metadata[key] for key in ("preset", "seed", "data", "samples")}


def begun(folder):
    return json.loads((folder / "config.json").read_text())


@pytest.fixture
def pretrain(few_shapes, minimal_variables, monkeypatch):
    """``pretrain(arguments)``: the exit status; the trainings' arguments are kept."""
    calls = []

    def stand_in(config, training, data, folder, seed, max_steps, start):
        calls.append((data, start))
        return None if max_steps else minimal_variables

    def run(*arguments):
        given = ["--preset=tiny", f"--data_dir={few_shapes}", *SMALL, *SAMPLES]
        return launching.run(train, *given, *arguments)

    monkeypatch.setattr(train, "pretrain", stand_in)
    run.calls = calls
    return run


def test_pretraining_goes_on_from_weights(
    pretrain, weights, minimal_variables, tmp_path
):
    assert pretrain(f"--workdir={tmp_path}", f"--weights={weights}") == 0
    ((_, start),) = pretrain.calls
    assert equal(start, minimal_variables)
    path = tmp_path / "weights.safetensors"
    expected = {"preset": "tiny", "seed": 0, "data": "shapes", "samples": 32}
    assert known(path) == expected
    assert read_metadata(str(path))["pretrained"] == BEFORE
    assert begun(tmp_path)["config"]["start"] == sha256(minimal_variables)


def test_pretraining_from_nothing_stops_and_resumes(pretrain, tmp_path, capsys):
    assert pretrain(f"--workdir={tmp_path}", "--max_steps=1") == 0
    assert pretrain.calls[0][1] is None
    stopped = f"stopped; resume with --workdir={tmp_path} --resume"
    assert stopped in capsys.readouterr().out
    assert pretrain(f"--workdir={tmp_path}", "--resume") == 0
    assert read_metadata(str(tmp_path / "weights.safetensors"))["pretrained"] is None


def test_the_order_of_batches_is_that_of_the_start(pretrain, weights, others, tmp_path):
    """The seed's own where there are no weights."""
    for n, start in enumerate((None, weights, weights, others)):
        given = [] if start is None else [f"--weights={start}"]
        assert pretrain(f"--workdir={tmp_path}/{n}", "--seed=3", *given) == 0
    seeds = [data.seed for data, _ in pretrain.calls]
    assert seeds[0] == 3 and seeds[1] == seeds[2] and len(set(seeds)) == 3


def test_what_is_no_matter_of_size_can_change(
    pretrain, weights, minimal_variables, tmp_path
):
    other = ("uses_visibility=True", "background=empty", "backbone.offset_reach=0.2")
    given = [f"--workdir={tmp_path}", f"--weights={weights}"]
    assert pretrain(*given, *(f"--set=model.{change}" for change in other)) == 0
    assert equal(pretrain.calls[0][1], minimal_variables)


@pytest.fixture(scope="module")
def meta(few_shapes, minimal_variables):
    """``meta(arguments)``: the exit status of a meta-training."""

    def run(*arguments) -> int:
        given = ["--phase=meta", "--preset=tiny", f"--data_dir={few_shapes}"]
        with pytest.MonkeyPatch.context() as patch:
            fresh = lambda key, model: minimal_variables  # noqa: E731
            patch.setattr(train, "init_variables", fresh)
            stand_in_networks.replace_networks(patch)
            return launching.run(train, *given, *arguments)

    return run


@pytest.fixture(scope="module")
def unbroken(meta, weights, tmp_path_factory):
    """The folder of a run from its first step to its last."""
    folder = tmp_path_factory.mktemp("runs") / "unbroken"
    assert meta(f"--workdir={folder}", f"--weights={weights}", *CHANGES) == 0
    return folder


def test_meta_training_writes_weights_and_where_they_come_from(
    unbroken, minimal, minimal_variables
):
    path = str(unbroken / "weights.safetensors")
    config, variables = load_pretrained(path)
    assert config == minimal.config
    for name in (*ENCODERS, "decoder", "refiner", "auxiliary"):
        same = bitwise(variables["params"][name], minimal_variables["params"][name])
        assert same == (name == "auxiliary"), name
    assert bitwise(variables["batch_stats"], minimal_variables["batch_stats"])
    expected = {"preset": "tiny", "seed": 0, "data": "shapes", "samples": 8}
    assert known(path) == expected
    metadata, run = read_metadata(path), begun(unbroken)
    assert metadata["pretrained"] == BEFORE
    settings = dataclasses.asdict(dataclasses.replace(minimal.meta, **META))
    assert metadata["meta"] == json.loads(json.dumps(settings))
    assert run["config"]["start"] == sha256(minimal_variables)
    assert metadata["commit"] == run["commit"]


def refused(capsys, status):
    printed = capsys.readouterr()
    assert (status, printed.out) == (2, "")
    (line,) = [x for x in printed.err.splitlines() if x.startswith("train: ")]
    return line


@pytest.mark.parametrize(
    ("flag", "fault"),
    [
        ("--weights=none", "none: no such weights; "),
        ("--set=model.backbone.num_initial=64", "not weights of tiny; use the preset"),
        ("--validation=shapes/test", "unknown value 'test'; use one of validation, "),
        ("--set=meta.num_samples=1", "samples do not fill a batch"),
    ],
)
def test_mistakes_are_refused_before_a_run_is_opened(
    meta, weights, tmp_path, capsys, flag, fault
):
    given = f"--workdir={tmp_path}/run", f"--weights={weights}", *CHANGES
    assert fault in refused(capsys, meta(*given, flag))
    assert not (tmp_path / "run").exists()


def test_a_run_is_resumed_only_as_it_was_begun(
    meta, unbroken, weights, others, capsys, monkeypatch
):
    """Other settings are refused before data are built."""
    given = [f"--workdir={unbroken}", f"--weights={weights}", *CHANGES]
    before = {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")}
    again = refused(capsys, meta(*given))
    assert "this folder already holds a run; resume it with" in again
    monkeypatch.setattr(train, "training_data", None)
    for flag in (
        f"--weights={others}",
        "--set=meta.learning_rate=0.2",
        "--seed=1",
        "--phase=pretrain",
    ):
        status = meta(*given, "--resume", flag)
        assert "configuration differs from the run" in refused(capsys, status)
    assert {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")} == before


def test_meta_training_from_nothing(meta, tmp_path, capsys):
    few, many = "--set=meta.batch_size=9", "--set=meta.num_samples=90"
    status = meta(f"--workdir={tmp_path}/few", *CHANGES, few, many)
    assert "8 examples do not fill a batch of 9" in refused(capsys, status)
    assert meta(f"--workdir={tmp_path}/run", "--max_steps=1", *CHANGES) == 0
    assert "stopped" in capsys.readouterr().out
