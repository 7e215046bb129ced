"""The launcher: what it writes, and how it ends. The network is a fake."""

import contextlib
import hashlib
import io
import json
import pathlib

import numpy as np
import pytest

import prism_jax
from experiments import evaluate
from experiments.assets import CELLS
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation.metrics import hausdorff
from prism_jax.evaluation.paired import paired_difference
from prism_jax.evaluation.run import Predictions
from prism_jax.geometry.visibility import BACKGROUND, MAP_SIZE, SURFACE
from tests import launching
from tests.public_sets import write_pcn, write_shapenet55


def fake(config, variables):
    """Moves the partial up, by the number of steps, alike in all poses; accepts every
    other frame."""

    def complete(partials, eyes, told=None):
        partials = np.concatenate([partials] * config.model.poses, axis=1)
        if config.adapt.num_steps == 0:
            return Predictions(partials)
        moved = partials + np.float32([0, 0, 0.01 * config.adapt.num_steps])
        accepted = np.arange(len(partials)) % 2 == 0
        return Predictions(moved, partials, accepted)

    return complete


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "prism_completer", fake)
        return launching.run(evaluate, *arguments)


def scored(output, *arguments) -> dict:
    """What a run that ends well writes, and the table that it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert run(*arguments, f"--output={output}") == 0
    return json.loads(output.read_text()) | {"table": printed.getvalue()}


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """Results on two frames of the robot cells that ship, in metres."""
    root = CELLS
    place = ["--dataset=recordings", f"--data_dir={root}", "--split=all", "--limit=2"]
    folder = tmp_path_factory.mktemp("cells")
    runs = {
        "adapted": ["--steps=2"],
        "plain": ["--steps=0"],
        "changed": ["--set=adapt.num_steps=2", "--set=adapt.step_size=0.5"],
        "oracle": ["--steps=0", "--normalisation=oracle"],
    }
    return {
        name: scored(folder / f"{name}.json", *place, *arguments)
        for name, arguments in runs.items()
    }


@pytest.mark.parametrize("asked", [True, False])
def test_weights_that_are_told_are_told_of_recordings(asked, tmp_path, monkeypatch):
    """`small` is, of what its frames' whole depth images show."""
    found = []

    def listening(config, variables):
        def complete(partials, eyes, *told):
            found.extend(told)
            return Predictions(np.concatenate([partials] * config.model.poses, axis=1))

        return complete

    monkeypatch.setattr(evaluate, "prism_completer", listening)
    place = ["--dataset=recordings", f"--data_dir={CELLS}", "--split=all", "--limit=2"]
    output = f"--output={tmp_path / 'scores.json'}"
    told = f"--set=model.uses_visibility={asked}"
    assert launching.run(evaluate, *place, told, output) == 0
    if asked:
        (one,) = found
        assert one.state.shape == (2, MAP_SIZE, MAP_SIZE)
        assert np.isin([SURFACE, BACKGROUND], one.state).all()
    assert bool(found) == asked


def test_changes_are_made_and_named(cells):
    changed = cells["changed"]
    assert changed["set"] == "adapt.num_steps=2 adapt.step_size=0.5"
    assert "set adapt.num_steps=2 adapt.step_size=0.5" in changed["table"]
    assert changed["steps"] == 2
    assert changed["clouds"] == cells["adapted"]["clouds"]
    assert "set" not in cells["adapted"]


def test_a_result_says_what_it_is_of(cells):
    result = cells["adapted"]
    assert list(result)[:11] == [
        *("data", "split", "digest", "protocol", "normalisation", "weights"),
        *("weights_sha256", "seed", "weights_commit", "steps", "commit"),
    ]
    shipped = pathlib.Path(prism_jax.__file__).parent / "assets" / "small.safetensors"
    digest = hashlib.sha256(shipped.read_bytes()).hexdigest()
    assert result["weights_sha256"] == digest
    assert len(result["digest"]) == 12
    assert (result["data"], result["split"]) == ("recordings", "all")
    assert (result["weights"], result["seed"], result["steps"]) == ("small", 0, 2)
    assert len(result["weights_commit"]) == 40
    assert (result["protocol"], result["normalisation"]) == ("standard", "partial")
    assert (result["num_examples"], result["accepted"]) == (2, 0.5)
    assert result["unit"] == "half the longest side of the complete cloud"
    table = result["table"]
    assert table.startswith("data recordings, split all, digest ")
    assert "weights small, seed 0, steps 2, commit " in table


def test_cells_are_scored_in_their_own_size_under_both_normalisations(cells):
    """What is given back has the partial's scores, by any frame."""
    partial, oracle = cells["plain"], cells["oracle"]
    assert oracle["normalisation"] == "oracle"
    partial, oracle = partial["clouds"], oracle["clouds"]
    assert oracle["partial"] == partial["partial"]
    for metric, value in partial["network"]["mean"].items():
        found = oracle["network"]["mean"][metric]
        assert np.isclose(found, value, rtol=1e-3), metric
    source = RecordedCells(CELLS)
    expected = []
    for example in (source[0], source[1]):
        half = np.ptp(example.complete, axis=0).max() / 2
        assert half < 0.9
        expected.append(hausdorff(example.partial, example.complete) / half)
    found = partial["partial"]["mean"]["hausdorff"]
    assert np.isclose(found, np.mean(expected), rtol=1e-5)


def test_the_command_tells_what_adaptation_changes_and_which_arm_carries_it(cells):
    result, table = cells["adapted"], cells["adapted"]["table"]
    assert result["per_example"]["category"] == ["panda", "ur5"]
    change = result["adaptation"]["completed"]["cd_l2"]
    assert change["num_categories"] == 2
    assert change["carried_by"]["category"] in ("panda", "ur5")
    assert "| completed, CD-L2 | " in table and "over 2 categories" in table
    assert "adaptation" not in cells["plain"]


def test_two_files_can_be_compared(cells):
    change = paired_difference(cells["plain"], cells["adapted"])
    assert change["change"] != 0
    assert change["num_examples"] == 2
    same = paired_difference(
        cells["plain"], cells["adapted"], clouds=("network", "network_unadapted")
    )
    assert (same["change"], same["interval"]) == (0, [0, 0])


def test_the_published_test_of_shapenet55_prints_its_columns(tmp_path):
    write_shapenet55(tmp_path / "set", 1)
    place = ["--dataset=shapenet55", f"--data_dir={tmp_path / 'set'}"]
    result = scored(tmp_path / "a.json", *place, "--protocol=published", "--steps=0")
    heads = ["CD-S", "CD-M", "CD-H", "CD-Avg", "F-Score@1%"]
    assert list(result["published"]) == heads
    assert (result["split"], result["normalisation"]) == ("test", "own")
    assert result["unit"] == "the data set's own unit"
    assert f"| CD-L2 x1e3 | {' | '.join(heads)} |" in result["table"]
    assert "emd" not in result["clouds"]["network"]["mean"]


def test_the_published_test_of_pcn_prints_its_columns(tmp_path):
    write_pcn(tmp_path / "set")
    place = ["--dataset=pcn", f"--data_dir={tmp_path / 'set'}", "--protocol=published"]
    result = scored(tmp_path / "a.json", *place, "--normalisation=partial")
    heads = ["airplane", "car", "Average", "F-Score@1%"]
    assert list(result["published"]) == heads
    assert (result["split"], result["normalisation"]) == ("test", "partial")
    assert f"| CD-L1 x1e3 | {' | '.join(heads)} |" in result["table"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["--dataset=kitti"], "no published protocol for split 'test' of kitti"),
        (
            ["--dataset=pcn", "--split=val"],
            "no published protocol for split 'val' of pcn",
        ),
        (["--dataset=pcn", "--limit=3"], "the published protocol uses the whole test"),
    ],
)
def test_a_test_that_was_not_published_ends_in_one_line(capsys, arguments, fault):
    assert run("--protocol=published", "--data_dir=none", *arguments) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run(f"--output={tmp_path / 'file' / 'a.json'}") == 2
    assert "cannot be written to" in capsys.readouterr().err
