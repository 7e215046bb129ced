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
from experiments.comparison import Row, comparison
from experiments.scored_run import Predictions
from experiments.summary import ExampleScores, summarise
from experiments.weights import located
from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.weights import load_pretrained, read_metadata, samples_seen
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation.metrics import Scores
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
    place = ["--dataset=recordings", f"--data_dir={CELLS}", "--limit=2"]
    place += ["--split=all", f"--output={output}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "prism_completer", fake)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert launching.run(module, *place, *arguments) == 0
    return json.loads(output.read_text()), printed.getvalue()


def test_table_one(tmp_path, monkeypatch):
    averaged = []

    def training_mean(source, margin, count):
        averaged.append(source)
        return np.zeros((count, 3), np.float32)

    moved = lambda partials, eyes: Predictions(partials + np.float32(0.01))  # noqa: E731
    sources = {"all": RecordedCells(CELLS), "seen": object()}
    for name, stand_in in {
        "training_mean": training_mean,
        "training_split": lambda dataset: "seen",
        "open_split": sources.get,
        "mirrored": lambda partials, count: partials,
        "network_completer": lambda module, variables: moved,
    }.items():
        monkeypatch.setattr(table_1, name, stand_in)
    given = "--longer=small", "--network=pcn"
    table, text = run(table_1, tmp_path / "1.json", *given)
    rows = table["rows"]
    assert list(rows) == [
        *("partial", "training mean", "partial and its mirror image", "PCN"),
        *("CRA-PCN", "PRISM, not adapted", "PRISM", table_1.TOLD),
        "small, not adapted",
    ]
    assert averaged == [sources["seen"]]
    assert table["against"] == "CRA-PCN" and table["data"] == "recordings"
    # The fake gives back the partial, of 512 points, if it does not adapt; and another
    # answer to who is told what else the scan holds.
    means = {label: row["mean"]["cd_l2"] for label, row in rows.items()}
    plain = means["PRISM, not adapted"]
    assert means["CRA-PCN"] == pytest.approx(plain)
    assert means["small, not adapted"] == pytest.approx(plain)
    for label in ("PRISM", table_1.TOLD, "PCN"):
        assert means[label] != pytest.approx(plain, rel=1e-4)
    change = table["told"]["cd_l2"]["change"]
    assert change == pytest.approx(means[table_1.TOLD] / plain - 1, rel=1e-4)
    _, variables = load_pretrained(located("prism"))
    assert rows["PRISM"]["parameters"] == table_1.count(variables)
    assert 0 < rows["CRA-PCN"]["parameters"] < rows["PRISM"]["parameters"]
    assert rows["training mean"]["parameters"] is None
    assert rows["training mean"]["samples"] is None
    for label, name in (("PRISM", "prism"), ("PCN", "pcn")):
        assert rows[label]["samples"] == samples_seen(read_metadata(located(name)))
    assert "| training mean | " in text and "| CD-L2 x1e4 | " in text


def test_ours_is_compared_with_the_best_of_the_others_metric_by_metric():
    def scored(**others):
        scores = Scores(**(dict.fromkeys(Scores._fields, 0.4) | others))
        clouds = {"partial": scores, "network": scores}
        examples = [ExampleScores(name, "bag", None, clouds) for name in "ab"]
        return Row({"unit": "metres", **summarise(examples, ("bag",), np.arange(2))})

    near = scored(precision_2=0.9, cd_l2=0.3, f_2=0.2)
    full = scored(recall_2=0.9, cd_l2=0.2, f_2=0.8)
    ours, none = scored(), {"nobody": scored(f_2=0.0)}
    assert "f_2" not in table_1.best_others(none, ours)
    found = table_1.best_others({"near": near, "full": full}, ours)
    best = {"precision_2": 0.9, "recall_2": 0.9, "cd_l2": 0.2, "f_2": 0.8}
    for metric, value in best.items():
        change = found[metric]["change"]["change"]
        assert change == pytest.approx(0.4 / value - 1, rel=1e-5)
        nearest = metric == "precision_2"
        assert found[metric]["row"] == ("near" if nearest else "full")
    rows = {"near": near, "full": full, table_1.OURS: ours}
    table = comparison(rows, "full") | {"best_others": found}
    lines = table_1.table_markdown(table).rpartition("\n\n")[2].splitlines()
    assert len(lines) == 2 + len(found) == 10
    assert lines[2].startswith("| CD-L2 x1e4 | full | 2000 ")


def test_the_script_trains_every_network_on_as_many_samples(scripted, tmp_path):
    place = f"--workdir={tmp_path}/run"
    given = ["--samples=640", "--seed=3", "--mixture=shapes:1"]
    status, told, commands = scripted("train_table_1.sh", place, *given)
    assert status == 0, told
    for name, *arguments in commands:
        launching.parse(name, *arguments)
        settings.resolve("small", [x[6:] for x in arguments if x[:6] == "--set="])
    assert [command[0] for command in commands] == ["train_baseline"] * len(
        NETWORKS
    ) + ["train"] * 2
    given_names = [flag for c in commands for flag in c if flag[:10] == "--network="]
    assert {flag[10:] for flag in given_names} == set(NETWORKS)
    for command in commands:
        assert {"--seed=3", "--mixture=shapes:1", "--preset=small"} <= set(command)
        if command[0] == "train":
            phases = "--set=pretrain.backbone.{}.num_samples={}"
            assert {phases.format(0, 0), phases.format(1, 640)} <= set(command)
        else:
            assert "--samples=640" in command
    table = told.strip().splitlines()[-1].split()
    assert table[:3] == ["python", "-m", "experiments.table_1"]
    assert sum(word.startswith("--network=") for word in table) == len(NETWORKS)
    launching.parse("table_1", *table[3:])
    # What is done is not done again, and others are not begun.
    assert scripted("train_table_1.sh", place, *given)[2] == []
    more = f"--workdir={tmp_path}/more"
    _, _, commands = scripted("train_table_1.sh", more, "--only=crapcn")
    assert [command[0] for command in commands] == ["train"]
    assert "--set=model.backbone.reads_visibility=False" in commands[0]
    status, told, commands = scripted("train_table_1.sh", more, "--only=nothing")
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
    labels = [*table_3.VARIANTS, "mine"]
    arguments = [f"--weights={label}=small-meta" for label in labels]
    table, _ = run(table_3, tmp_path / "3.json", *arguments)
    rows = table["rows"]
    assert list(rows)[:-2] == [
        *("partial", "none", "align, not adapted", "align"),
        *("align + normal, not adapted", "align + normal"),
        *("align + denoise, not adapted", "align + denoise", "all, not adapted", "all"),
    ]
    means = {label: row["mean"]["cd_l2"] for label, row in rows.items()}
    # All were given the same weights. The fake moves by its steps: not those of
    # "none", whatever its weights say.
    assert means["none"] == means["all, not adapted"] != means["all"] == means["align"]
    assert table["against"] == "none"


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
