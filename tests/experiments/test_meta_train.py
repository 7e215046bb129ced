"""The launcher: what it writes, where it goes on, and how it ends.

The networks of the meta-step are a stand-in; variables, data, optimisers, checkpoints
and files are the real ones.
"""

import dataclasses
import json
import re
import shutil

import pytest

from experiments import meta_train, training
from experiments.simulation.shapes.build import ShapesConfig, build_shapes
from prism_jax.models.variables import ENCODERS
from prism_jax.weights import load_pretrained, read_metadata, save_weights, sha256
from tests import launching, stand_in_networks
from tests.trees import bitwise

NETWORK = (
    "num_neighbors=(4,)",
    "encoder_rates=(1,)",
    "level_rates=((1,),)",
    "up_factors=(2,)",
)
TRAINING = ("num_samples=8", "batch_size=2", "validate_every=4", "learning_rate=0.1")
CHANGES = [
    *(f"--set=model.backbone.{change}" for change in NETWORK),
    *(f"--set=meta.{change}" for change in TRAINING),
]
BEFORE = {"preset": "tiny", "seed": 5, "commit": None, "data": "shapes", "samples": 64}


@pytest.fixture(scope="module")
def weights(tmp_path_factory, minimal, minimal_variables):
    """Pretrained ones, as the pretraining leaves them."""
    path = tmp_path_factory.mktemp("weights") / "pretrained.safetensors"
    known = BEFORE | {"scores": {"cd_l2": 1.0}}
    save_weights(path, minimal.config, minimal_variables, known)
    return path


@pytest.fixture(scope="module")
def run(few_shapes, minimal_variables):
    """``run(arguments)``: the command's exit status."""

    def run(*arguments) -> int:
        given = ["--preset=tiny", f"--data_dir={few_shapes}", *arguments]
        with pytest.MonkeyPatch.context() as patch:
            fresh = lambda key, model: minimal_variables  # noqa: E731
            patch.setattr(meta_train, "init_variables", fresh)
            patch.setattr(training, "index_table", lambda *arguments: None)
            stand_in_networks.replace_networks(patch)
            return launching.run(meta_train, *given)

    return run


@pytest.fixture(scope="module")
def unbroken(run, weights, tmp_path_factory):
    """The folder of a run from its first step to its last."""
    folder = tmp_path_factory.mktemp("runs") / "unbroken"
    assert run(f"--workdir={folder}", f"--weights={weights}", *CHANGES) == 0
    return folder


def printed_sha(text):
    return re.search(r"^sha256 ([0-9a-f]{64})$", text, re.MULTILINE).group(1)


def test_it_writes_weights_and_what_is_known_of_them(
    unbroken, minimal, minimal_variables, weights
):
    path = str(unbroken / "weights.safetensors")
    adapt, variables = load_pretrained(path)
    assert adapt == minimal.config
    for name in (*ENCODERS, "decoder", "refiner", "auxiliary"):
        same = bitwise(variables["params"][name], minimal_variables["params"][name])
        assert same == (name == "auxiliary"), name
    assert bitwise(variables["batch_stats"], minimal_variables["batch_stats"])
    metadata = read_metadata(path)
    known = {key: metadata[key] for key in ("preset", "seed", "data", "samples")}
    assert known == {"preset": "tiny", "seed": 0, "data": "shapes", "samples": 8}
    assert metadata["pretrained"] == BEFORE
    config = dataclasses.replace(
        minimal.meta,
        num_samples=8,
        batch_size=2,
        validate_every=4,
        learning_rate=0.1,
    )
    assert metadata["meta"] == json.loads(json.dumps(dataclasses.asdict(config)))
    run = json.loads((unbroken / "config.json").read_text())
    assert run["config"]["start"] == sha256(load_pretrained(str(weights))[1])
    assert metadata["commit"] == run["commit"]


def test_it_logs_every_validation(unbroken):
    text = (unbroken / "metrics.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    assert {line["phase"] for line in lines} == {"meta"}
    validations = [line for line in lines if "validation" in line]
    assert [line["step"] for line in validations] == [2, 4]
    for line in validations:
        assert set(line["validation"]) == {"unadapted", "accepted", "adapted"}
    losses = [line["losses"] for line in lines if "losses" in line]
    assert len(losses) == 2
    assert list(losses[0])[-1] == "adapted"


@pytest.mark.slow
def test_stopped_and_resumed_it_ends_the_same(run, unbroken, weights, tmp_path, capsys):
    """The files bit for bit; and a run that is done is not done again."""
    folder = tmp_path / "broken"
    given = [f"--workdir={folder}", f"--weights={weights}", *CHANGES]
    assert run(*given, "--max_steps=2") == 0
    stopped = capsys.readouterr().out
    assert f"stopped; go on with --workdir={folder} --resume\n" in stopped
    assert not (folder / "weights.safetensors").exists()
    assert run(*given, "--resume") == 0
    ended = capsys.readouterr().out
    path = folder / "weights.safetensors"
    assert f"written {path}\n" in ended
    assert printed_sha(stopped) != printed_sha(ended)
    expected = (unbroken / "weights.safetensors").read_bytes()
    assert path.read_bytes() == expected
    assert run(*given, "--resume") == 0
    assert printed_sha(capsys.readouterr().out) == printed_sha(ended)
    assert path.read_bytes() == expected


def refused(capsys, status):
    printed = capsys.readouterr()
    assert status == 2
    assert printed.out == ""
    (line,) = [x for x in printed.err.splitlines() if x.startswith("meta_train: ")]
    return line


def test_weights_of_another_preset_are_refused(run, weights, tmp_path, capsys):
    """Before a run is opened: the same command with other flags can follow."""
    folder = tmp_path / "run"
    status = run(f"--workdir={folder}", f"--weights={weights}")
    message = refused(capsys, status)
    assert message.startswith(f"meta_train: {weights}: not weights of tiny; choose ")
    assert not folder.exists()


def test_weights_that_are_not_there_are_refused(run, tmp_path, capsys):
    status = run(f"--workdir={tmp_path}/run", "--weights=none", *CHANGES)
    assert refused(capsys, status).startswith("meta_train: none: no such weights; ")


def test_a_run_goes_on_only_as_it_was_begun(run, unbroken, weights, tmp_path, capsys):
    given = [f"--workdir={unbroken}", *CHANGES]
    before = {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")}
    again = run(*given, f"--weights={weights}")
    assert "it holds a run already; pass --resume" in refused(capsys, again)
    config, variables = load_pretrained(str(weights))
    logits = variables["weighting"]["logits"] + 1
    changed = {**variables, "weighting": {**variables["weighting"], "logits": logits}}
    other = tmp_path / "other.safetensors"
    save_weights(other, config, changed, BEFORE)
    resumed = (
        [f"--weights={other}"],
        [f"--weights={weights}", "--set=meta.learning_rate=0.2"],
        [f"--weights={weights}", "--seed=1"],
    )
    for flag in resumed:
        status = run(*given, "--resume", *flag)
        assert "its run has another configuration" in refused(capsys, status)
    assert {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")} == before


def test_nor_on_other_data(run, unbroken, few_shapes, weights, tmp_path, capsys):
    """Wherever they lie."""
    shutil.copytree(few_shapes, tmp_path / "same")
    given = [f"--workdir={unbroken}", *CHANGES, f"--weights={weights}", "--resume"]
    assert run(*given, f"--data_dir={tmp_path / 'same'}") == 0
    capsys.readouterr()
    for split in ("validation", "train"):
        shutil.rmtree(tmp_path / "same" / f"shapes-{split}")
        others = ShapesConfig(split, num_shapes=8, num_views=1, seed=1)
        build_shapes(others, tmp_path / "same", 0, False)
        status = run(*given, f"--data_dir={tmp_path / 'same'}")
        assert f"config.data.digests.{split} is" in refused(capsys, status)


def test_without_weights_it_starts_from_fresh_ones(run, tmp_path, capsys):
    assert run(f"--workdir={tmp_path}/run", "--max_steps=1", *CHANGES) == 0
    assert "stopped" in capsys.readouterr().out


def test_a_batch_that_the_data_do_not_fill(run, weights, tmp_path, capsys):
    given = [f"--workdir={tmp_path}/run", f"--weights={weights}", *CHANGES]
    status = run(*given, "--set=meta.batch_size=9", "--set=meta.num_samples=90")
    assert "8 examples do not fill a batch of 9" in refused(capsys, status)
