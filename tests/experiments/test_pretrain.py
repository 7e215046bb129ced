"""The launcher: what it starts from, and what its weights tell. The training is a
stand-in; `tests/training/test_pretraining.py` has the real order of the phases."""

import json

import jax
import numpy as np
import pytest

from experiments import pretrain, training
from prism_jax.weights import load_pretrained, read_metadata, save_weights, sha256
from tests import launching

NETWORK = (
    "num_neighbors=(4,)",
    "encoder_rates=(1,)",
    "level_rates=((1,),)",
    "up_factors=(2,)",
)
CHANGES = [
    *(f"--set=model.backbone.{change}" for change in NETWORK),
    *(f"--set=pretrain.backbone.{i}.num_samples={n}" for i, n in enumerate((0, 32))),
]
BEFORE = {"preset": "tiny", "seed": 5, "commit": None, "data": "shapes", "samples": 64}


@pytest.fixture(scope="module")
def variables(minimal_variables):
    return minimal_variables


@pytest.fixture(scope="module")
def weights(tmp_path_factory, minimal, variables):
    path = tmp_path_factory.mktemp("weights") / "before.safetensors"
    save_weights(path, minimal.config, variables, BEFORE)
    return path


@pytest.fixture
def run(few_shapes, variables, monkeypatch):
    """``run(arguments)``: the command's exit status, and what it started from."""
    starts = []

    def train(config, pretraining, data, folder, seed, max_steps, tensorboard, start):
        starts.append(start)
        return None if max_steps else variables

    def run(*arguments):
        given = ["--preset=tiny", f"--data_dir={few_shapes}", *CHANGES, *arguments]
        return launching.run(pretrain, *given), starts

    monkeypatch.setattr(pretrain, "pretrain", train)
    return run


def test_it_goes_on_from_weights_and_tells_of_both_trainings(
    run, weights, variables, tmp_path
):
    status, (start,) = run(f"--workdir={tmp_path}", f"--weights={weights}")
    assert status == 0
    assert jax.tree.structure(start) == jax.tree.structure(variables)
    assert jax.tree.all(jax.tree.map(np.array_equal, start, variables))
    metadata = read_metadata(str(tmp_path / "weights.safetensors"))
    known = {key: metadata[key] for key in ("preset", "seed", "data", "samples")}
    assert known == {"preset": "tiny", "seed": 0, "data": "shapes", "samples": 32}
    assert metadata["pretrained"] == BEFORE
    begun = json.loads((tmp_path / "config.json").read_text())["config"]
    assert begun["start"] == sha256(load_pretrained(str(weights))[1])


@pytest.mark.parametrize(
    ("num_samples", "auxiliary", "made"), [(8, 0, False), (16, 0, True), (8, 4, True)]
)
def test_indices_are_made_beforehand_where_examples_come_again(
    run, tmp_path, monkeypatch, num_samples, auxiliary, made
):
    """The corpus has eight."""
    monkeypatch.setattr(training, "index_table", lambda *arguments: "made")
    seen = []
    monkeypatch.setattr(
        pretrain, "pretrain", lambda config, pretraining, data, *rest: seen.append(data)
    )
    changed = [f"--set=pretrain.backbone.1.num_samples={num_samples}"]
    changed.append(f"--set=pretrain.auxiliary_samples={auxiliary}")
    assert run(f"--workdir={tmp_path}", *changed)[0] == 0
    assert [data.indices for data in seen] == ["made" if made else None]


def test_batches_come_in_another_order_after_other_weights(
    run, weights, minimal, variables, tmp_path, monkeypatch
):
    """The same for the same weights, and the seed's own where there are none."""
    other = tmp_path / "other.safetensors"
    changed = {**variables, "params": jax.tree.map(np.negative, variables["params"])}
    save_weights(other, minimal.config, changed, BEFORE)
    seeds = []
    keep = lambda config, pretraining, data, *rest: seeds.append(data.seed)  # noqa: E731
    monkeypatch.setattr(pretrain, "pretrain", keep)
    for n, start in enumerate((None, weights, weights, other)):
        given = [] if start is None else [f"--weights={start}"]
        assert run(f"--workdir={tmp_path}/{n}", "--seed=3", *given)[0] == 0
    assert seeds[0] == 3 and seeds[1] == seeds[2] and len(set(seeds)) == 3


def test_without_weights_it_starts_afresh(run, tmp_path, capsys):
    assert run(f"--workdir={tmp_path}", "--max_steps=1") == (0, [None])
    assert (
        f"stopped; go on with --workdir={tmp_path} --resume" in capsys.readouterr().out
    )
    assert run(f"--workdir={tmp_path}", "--resume")[0] == 0
    assert read_metadata(str(tmp_path / "weights.safetensors"))["pretrained"] is None


@pytest.mark.slow
def test_a_network_with_one_more_block_goes_on_from_one_without(
    run, weights, variables, tmp_path
):
    more = ("up_factors=(2,4)", "level_rates=((1,),(1,))")
    changes = [f"--set=model.backbone.{change}" for change in more]
    place = f"--workdir={tmp_path}", "--max_steps=1"
    status, (start,) = run(*place, f"--weights={weights}", *changes)
    assert status == 0
    for kind in ("params", "batch_stats"):
        new = start[kind]["decoder"]
        assert new.keys() - variables[kind]["decoder"].keys() == {"block_1"}
        old = {**start[kind], "decoder": {**new}}
        del old["decoder"]["block_1"]
        assert jax.tree.all(jax.tree.map(np.array_equal, old, variables[kind]))


def test_weights_of_another_network_are_refused(run, weights, tmp_path, capsys):
    change = "--set=model.backbone.num_initial=64"
    status, starts = run(f"--workdir={tmp_path}/run", f"--weights={weights}", change)
    assert (status, starts) == (2, [])
    assert "not weights of tiny; choose the preset" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_what_weights_are_told_is_no_matter_of_their_size(run, weights, tmp_path):
    changes = ("--set=model.told=True", "--set=model.background=empty")
    status, (start,) = run(
        f"--workdir={tmp_path}/run", f"--weights={weights}", "--max_steps=1", *changes
    )
    assert status == 0 and start is not None


def test_how_far_offsets_reach_can_change(run, weights, variables, tmp_path):
    change = "--set=model.backbone.offset_reach=0.2"
    status, (start,) = run(
        f"--workdir={tmp_path}/run", f"--weights={weights}", "--max_steps=1", change
    )
    assert status == 0
    assert jax.tree.all(jax.tree.map(np.array_equal, start, variables))


def test_a_share_of_whole_views_is_of_a_mixture(run, tmp_path, capsys):
    assert run(f"--workdir={tmp_path}/run", "--whole=0.5") == (2, [])
    assert "--whole: is of a mixture; give --mixture too" in capsys.readouterr().err
