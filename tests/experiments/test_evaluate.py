"""The launcher: what it writes, and how it ends. The network is a fake."""

import contextlib
import io
import json

import numpy as np
import pytest

from experiments import evaluate
from experiments.assets import CELLS
from experiments.published import PUBLISHED
from experiments.scored_run import Predictions
from experiments.weights import located
from prism_jax.completion.weights import file_sha256
from tests import launching
from tests.public_sets import write_shapenet

PLACE = ["--dataset=recordings", f"--data_dir={CELLS}", "--split=all", "--limit=2"]
TOLD = []


def fake(config, variables):
    """Moves the partial up, by the number of steps, alike in all poses; accepts every
    other frame."""

    def complete(partials, eyes, *told):
        TOLD.extend(told)
        partials = np.concatenate([partials] * config.model.poses, axis=1)
        if config.adapt.num_steps == 0:
            return Predictions(partials)
        moved = partials + np.float32([0, 0, 0.01 * config.adapt.num_steps])
        accepted = np.arange(len(partials)) % 2 == 0
        return Predictions(moved, partials, accepted)

    return complete


def scored(output, *arguments) -> dict:
    """What a run that ends well writes, the table that it prints, and what its network
    was told."""
    TOLD.clear()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(io.StringIO()) as printed,
    ):
        patch.setattr(evaluate, "prism_completer", fake)
        assert launching.run(evaluate, *arguments, f"--output={output}") == 0
    more = {"table": printed.getvalue(), "told": [*TOLD]}
    return json.loads(output.read_text()) | more


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """Results on two frames of the robot cells that ship, in metres."""
    folder = tmp_path_factory.mktemp("cells")
    changed = ["--set=adapt.num_steps=2", "--set=adapt.step_size=0.5"]
    runs = {
        "adapted": ["--steps=2"],
        "changed": [*changed, "--set=model.uses_visibility=False"],
        "plain": ["--steps=0", "--normalisation=oracle"],
    }
    return {
        name: scored(folder / f"{name}.json", *PLACE, *arguments)
        for name, arguments in runs.items()
    }


def test_a_result_says_what_it_is_of(cells):
    result = cells["adapted"]
    assert list(result)[:11] == [
        *("data", "split", "digest", "protocol", "normalisation", "weights"),
        *("weights_sha256", "seed", "weights_commit", "steps", "commit"),
    ]
    assert result["weights_sha256"] == file_sha256(located("small"))
    assert (result["data"], result["split"]) == ("recordings", "all")
    assert (result["weights"], result["seed"], result["steps"]) == ("small", 0, 2)
    assert len(result["weights_commit"]) == 40 and len(result["digest"]) == 12
    assert (result["num_examples"], result["accepted"]) == (2, 0.5)
    assert "weights small, seed 0, steps 2, commit " in result["table"]
    changed = cells["changed"]
    assert changed["clouds"] == result["clouds"]
    assert "set adapt.num_steps=2 adapt.step_size=0.5" in changed["table"]


def test_the_command_tells_what_adaptation_changes_and_which_arm_carries_it(cells):
    result, table = cells["adapted"], cells["adapted"]["table"]
    change = result["adaptation"]["completed"]["cd_l2"]
    assert change["num_categories"] == 2
    assert change["carried_by"]["category"] in ("panda", "ur5")
    assert "| completed, CD-L2 | " in table and "over 2 categories" in table
    plain = cells["plain"]
    assert "adaptation" not in plain and plain["normalisation"] == "oracle"


def test_a_published_test_prints_its_columns(tmp_path):
    place = [f"--dataset={PUBLISHED[0]}", f"--data_dir={tmp_path / 'set'}", "--steps=0"]
    write_shapenet(tmp_path / "set")
    result = scored(tmp_path / "a.json", *place, "--protocol=published")
    columns = ["CD-S", "CD-M", "CD-H", "CD-Avg", "F-Score@1%"]
    assert list(result["published"]) == columns
    assert (result["split"], result["normalisation"]) == ("test", "own")
    assert f"| {' | '.join(['CD-L2 x1e3', *columns])} |" in result["table"]
    assert "emd" not in result["clouds"]["network"]["mean"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (
            ["--dataset=shapenet55", "--split=train"],
            "no published protocol for split 'train' of shapenet55",
        ),
        (["--dataset=shapenet55", "--limit=3"], "uses the whole test split"),
        (["--output=/dev/null/a.json"], "cannot be written"),
    ],
)
def test_a_mistake_ends_in_one_line_before_the_work(capsys, arguments, fault):
    given = "--protocol=published", "--data_dir=none"
    assert launching.run(evaluate, *given, *arguments) == 2
    error = capsys.readouterr().err
    assert fault in error and error.count("\n") == 1
