"""The launchers of Tables I to III. The networks are fakes, or adapt by none."""

import contextlib
import io
import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import settings, table_1, table_2, table_3
from experiments.assets import CELLS
from experiments.baselines.networks import NETWORKS
from experiments.baselines.pcn import PCN
from experiments.baselines.weights import load_network, with_weights
from experiments.comparison import Row, comparison
from experiments.scoring import in_one_pose, network_size, prism_size
from experiments.weights import located
from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.weights import (
    load_pretrained,
    read_metadata,
    samples_seen,
    save_weights,
)
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation.protocol import Protocol
from prism_jax.evaluation.run import Predictions, evaluate, network_completer
from prism_jax.models.variables import pop_encoders
from tests import launching


def fake(config, variables):
    """Moves the partial up, by its steps and the weight of the first loss."""

    def complete(partials, eyes, told=None):
        if told is not None:
            return Predictions(partials + np.float32(0.02))
        weight = float(jnp.exp(variables["weighting"]["logits"][0]))
        moved = partials + np.float32([0, 0, 0.01 * weight * config.adapt.num_steps])
        accepted = np.ones(len(partials), bool)
        return Predictions(moved, partials, accepted)

    return complete


def run(module, output, *arguments):
    """The table that the command writes, and what it prints."""
    root = CELLS
    place = ["--dataset=recordings", f"--data_dir={root}", "--limit=2"]
    place += ["--split=all", f"--output={output}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "prism_completer", fake)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert launching.run(module, *place, *arguments) == 0
    return json.loads(output.read_text()), printed.getvalue()


def quick_networks(module, variables):
    """PCN as it is, and of others the partial, moved further the more parameters."""
    if isinstance(module, PCN):
        return network_completer(module, variables)
    step = np.float32(1e-9 * table_1.count(variables))
    return lambda partials, eyes: Predictions(partials + step)


@pytest.mark.slow
def test_table_one(tmp_path, monkeypatch):
    monkeypatch.setattr(table_1, "network_completer", quick_networks)
    table, text = run(table_1, tmp_path / "1.json", "--longer=small")
    rows = table["rows"]
    assert list(rows) == [
        *("partial", "training mean", "partial and its mirror image"),
        *(table_1.LABELS[name] for name in with_weights()),
        *("CRA-PCN", "PRISM, not adapted", "PRISM", table_1.TOLD),
        "small, not adapted",
    ]
    # The fake gives back the partial, whatever the weights. The assignment of the EMD
    # starts from that of the cloud before, and adds up in another order.
    small, ours = (rows[f"{name}, not adapted"]["mean"] for name in ("small", "PRISM"))
    assert small == pytest.approx(ours, rel=1e-12)
    assert table["against"] == "CRA-PCN"
    others = [rows[table_1.LABELS[name]] for name in with_weights() if name != "pcn"]
    others.sort(key=lambda row: row["parameters"])
    moved = [row["mean"]["cd_l2"] for row in others]
    assert moved == sorted(set(moved))
    # The fake gives back the partial, of 512 points, if it does not adapt.
    plain, adapted = rows["PRISM, not adapted"]["mean"], rows["PRISM"]["mean"]
    assert rows["CRA-PCN"]["mean"] == pytest.approx(plain)
    assert adapted["cd_l2"] != pytest.approx(plain["cd_l2"], rel=0.01)
    # It gives another answer to who is told what else the scan holds.
    assert rows[table_1.TOLD]["mean"]["cd_l2"] != pytest.approx(
        plain["cd_l2"], rel=0.01
    )
    _, variables = load_pretrained(located("prism"))
    assert rows["PRISM"]["parameters"] == table_1.count(variables)
    assert 0 < rows["CRA-PCN"]["parameters"] < rows["PRISM"]["parameters"]
    assert rows["training mean"]["parameters"] is None
    assert rows["training mean"]["samples"] is None
    assert rows["PRISM"]["samples"] == samples_seen(read_metadata(located("prism")))
    assert rows["PCN"]["samples"] == samples_seen(read_metadata(located("pcn")))
    assert "| training mean | " in text
    assert len(table["best_others"]) == 7
    assert "| CD-L2 x1e4 | " in text
    told = rows[table_1.TOLD]["mean"]["cd_l2"] / plain["cd_l2"] - 1
    assert table["told"]["cd_l2"]["change"] == pytest.approx(told, rel=1e-4)
    assert table["data"] == "recordings"


def test_ours_is_compared_with_the_best_of_the_others_metric_by_metric():
    protocol = Protocol(256, 1.4, with_measured=False)

    def scored(fraction, shift):
        def complete(partials, _):
            count = int(fraction * partials.shape[1])
            return Predictions(partials[:, :count] + np.float32(shift))

        return Row(evaluate(complete, RecordedCells(CELLS), protocol))

    rows = {"near": scored(0.25, 0), "full": scored(1, 0.01), "ours": scored(1, 0.02)}
    found = table_1.best_others({k: rows[k] for k in ("near", "full")}, rows["ours"])
    assert found["prediction_to_truth"]["row"] == "near"
    assert found["truth_to_prediction"]["row"] == "full"
    for metric, best in found.items():
        mean, ours = (
            rows[name].result["clouds"]["network"]["mean"][metric]
            for name in (best["row"], "ours")
        )
        assert best["change"]["change"] == pytest.approx(ours / mean - 1, rel=1e-5)
        others = [
            rows[name].result["clouds"]["network"]["mean"][metric]
            for name in ("near", "full")
        ]
        assert mean == (max(others) if metric == "f_score" else min(others))
    table = comparison(rows | {table_1.OURS: rows["ours"]}, "full")
    text = table_1.table_markdown(table | {"best_others": found})
    lines = text.rpartition("\n\n")[2].splitlines()
    assert len(lines) == 2 + len(found) == 9
    assert lines[2].startswith(f"| CD-L2 x1e4 | {found['cd_l2']['row']} | ")


def test_the_script_trains_every_network_on_as_many_samples(scripted, tmp_path):
    place = f"--workdir={tmp_path}/run"
    given = ["--samples=640", "--seed=3", "--mixture=shapes:1"]
    status, told, commands = scripted("train_table_1.sh", place, *given)
    assert status == 0, told
    for name, *arguments in commands:
        launching.parse(name, *arguments)
        changes = [flag[6:] for flag in arguments if flag.startswith("--set=")]
        settings.resolve("small", changes)
    names = [command[0] for command in commands]
    assert names == ["train_baseline"] * len(NETWORKS) + ["train"] * 2
    assert {
        flag.partition("=")[2]
        for command in commands
        for flag in command
        if flag.startswith("--network=")
    } == set(NETWORKS)
    for command in commands:
        assert {"--seed=3", "--mixture=shapes:1", "--preset=small"} <= set(command)
    for command in commands[:-2]:
        assert "--samples=640" in command
    for command in commands[-2:]:
        phases = (128, 512)
        assert {
            f"--set=pretrain.backbone.{i}.num_samples={count}"
            for i, count in enumerate(phases)
        } <= set(command)
    table = told.strip().splitlines()[-1].split()
    assert table[:3] == ["python", "-m", "experiments.table_1"]
    named = [word for word in table if word.startswith("--network=")]
    assert len(named) == len(NETWORKS)
    launching.parse("table_1", *table[3:])
    # What is done is not done again, and others are not begun.
    assert scripted("train_table_1.sh", place, *given)[2] == []
    more = f"--workdir={tmp_path}/more"
    _, _, commands = scripted("train_table_1.sh", more, "--only=crapcn")
    assert [command[0] for command in commands] == ["train"]
    assert "--set=model.backbone.reads_visibility=False" in commands[0]
    for wrong in ("--only=nothing", "--samples=half", "nothing"):
        status, told, commands = scripted("train_table_1.sh", more, wrong)
        assert status == 2 and not commands and told.startswith("train_table_1: ")


def test_table_two(tmp_path, monkeypatch):
    def online(config, variables):
        return fake(config, table_2.equally_weighted(variables))

    monkeypatch.setattr(table_2, "online_completer", online)
    arguments = ("--pretrained=small-meta-pretrained", "--steps=2")
    table, _ = run(table_2, tmp_path / "2.json", *arguments)
    rows = table["rows"]
    steps = load_pretrained(located("small-meta"))[0].adapt.num_steps
    assert list(rows) == [
        *(f"pretrained, K = {k}" for k in (0, 2)),
        *(f"meta-trained, K = {k}" for k in (0, 2)),
        f"meta-trained, K = {steps}, equal weights",
        f"meta-trained, K = {steps}, online",
    ]
    means = {label: row["mean"]["cd_l2"] for label, row in rows.items()}
    assert means["pretrained, K = 0"] == means["meta-trained, K = 0"]
    assert means["meta-trained, K = 0"] != means["meta-trained, K = 2"]
    assert table["against"] == "pretrained, K = 0"


def test_table_three(tmp_path):
    arguments = [f"--weights={label}=small-meta" for label in table_3.VARIANTS]
    table, _ = run(table_3, tmp_path / "3.json", *arguments)
    rows = table["rows"]
    assert list(rows) == [
        *("partial", "none", "align, not adapted", "align"),
        *("align + normal, not adapted", "align + normal"),
        *("align + denoise, not adapted", "align + denoise", "all, not adapted", "all"),
    ]
    means = {label: row["mean"]["cd_l2"] for label, row in rows.items()}
    # The fake moves by its steps: not those of "none", whatever its weights say.
    assert means["none"] == means["all, not adapted"] != means["all"]
    assert table["against"] == "none"


def test_table_three_asks_for_a_label(tmp_path, capsys):
    with pytest.raises(AssertionError):
        run(table_3, tmp_path / "3.json", "--weights=small")
    assert "write LABEL=NAME|FILE" in capsys.readouterr().err


@pytest.mark.parametrize(
    "module", [table_3, table_2, pytest.param(table_1, marks=pytest.mark.slow)]
)
def test_weights_of_several_sizes_are_refused_before_the_first_is_scored(
    module, tmp_path, capsys, monkeypatch, minimal, minimal_variables
):
    path = tmp_path / "minimal.safetensors"
    save_weights(path, minimal.config, minimal_variables, {})
    monkeypatch.setattr(module, "run_evaluation", None)
    flag = f"--weights={'all=' if module is table_3 else ''}{path}"
    place = ("--dataset=shapes", f"--data_dir={tmp_path}")
    assert launching.run(module, flag, *place) == 2
    told = capsys.readouterr().err
    small, sizes = "512 points to 2048, margin 1.4", told.partition("made for ")[2]
    assert small in sizes and "64 points to 64, margin 1.4" in sizes
    assert [*tmp_path.iterdir()] == [path]


def test_online_goes_on_from_the_encoders_of_the_frame_before(monkeypatch):
    def make_adapt(config):
        def adapt(variables, partial, camera):
            encoders, rest = pop_encoders(variables)
            assert rest["params"] == {"decoder": 0}
            count = encoders["point_encoder"]
            after = {"point_encoder": count + 1, "depth_encoder": count}
            there = partial + count
            return Completion(there, partial, jnp.bool_(True), None, None, after, None)

        return adapt

    monkeypatch.setattr(table_2, "make_adapt", make_adapt)
    params = {"point_encoder": jnp.float32(0), "depth_encoder": jnp.float32(0)}
    variables = {"params": {**params, "decoder": 0}}
    complete = table_2.online_completer(None, variables)
    partials, eyes = np.zeros((2, 4, 3), np.float32), np.ones((2, 3), np.float32)
    partials[:, 0] = 1.0
    outputs = [complete(partials, eyes).network for _ in range(2)]
    moved = np.concatenate(outputs)[:, 1, 0]
    assert moved.tolist() == [0, 1, 2, 3]


def test_equal_weights_are_those_before_learning():
    _, variables = load_pretrained("small")
    logits = variables["weighting"]["logits"] + jnp.array([1.0, 2.0, 3.0])
    moved = {**variables, "weighting": {**variables["weighting"], "logits": logits}}
    found = table_2.equally_weighted(moved)
    assert not found["weighting"]["logits"].any()
    logits = jnp.array([-jnp.inf, 2.0, 3.0])
    moved["weighting"] = {**moved["weighting"], "logits": logits}
    alone = table_2.equally_weighted(moved)["weighting"]["logits"]
    assert alone.tolist() == [-np.inf, 0, 0]
    assert found["params"] is variables["params"]


def test_networks_are_compared_in_one_pose():
    """Else ours would have as many times the others' points as it has poses."""
    assert load_pretrained("small")[0].model.poses > 1
    config, _ = in_one_pose("small")
    size = prism_size(config)
    module, variables = load_network("pcn")
    assert size == network_size(module, variables, config.model.margin)
