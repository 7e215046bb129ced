"""From nothing to weights by one script: its commands in order, and how it goes on.

Python is a stand-in (`scripted`).
"""

import functools
import os

import pytest

from tests import launching

TRAIN = 3 * ["train"]
SCORES = ["evaluate", "evaluate", "release"]


@pytest.fixture
def run(scripted, tmp_path):
    """``run(*arguments)``: the exit status, what is told, and the commands."""
    return functools.partial(scripted, "train_release.sh", f"--workdir={tmp_path}/run")


def names(commands):
    return [command[0] for command in commands]


def test_the_commands_in_order(run, tmp_path):
    given = ["--preset=tiny", "--seed=4", "--set=meta.num_samples=64", "--data_dir=d"]
    status, told, commands = run(*given, "--scored=shapes=d", "--scored_at_once=2")
    assert status == 0, told
    assert names(commands) == ["opened", *TRAIN, *SCORES, *SCORES]
    assert commands[0] == ["opened", "shapes", "d"]
    for name, *arguments in commands[1:]:
        launching.parse(name, *arguments)
    pretrain, meta, control = map(set, commands[1:4])
    for command in (pretrain, meta, control):
        assert {*given, "--resume"} <= command
    assert "--phase=pretrain" in pretrain
    assert not [flag for flag in pretrain if flag.startswith("--weights")]
    folder = tmp_path / "run"
    start = f"--weights={folder}/pretrained/weights.safetensors"
    assert {start, "--phase=meta"} <= meta & control
    # The control is the same training without the method.
    changes = {flag for flag in meta ^ control if "workdir" not in flag}
    assert changes == {
        "--set=meta.method.num_steps=0",
        "--set=meta.method.lambda_aux=0.0",
        "--set=meta.method.learn_steps=False",
        "--set=meta.method.learn_auxiliary=False",
        "--set=adapt.num_steps=0",
    }
    for command in commands[4:6]:
        assert {"--dataset=shapes", "--data_dir=d", "--batch_size=2"} <= set(command)
    scores = [f"--scores={folder}/meta-shapes-{s}.json" for s in ("validation", "test")]
    assert {*scores, "--name=tiny", f"--output_dir={folder}"} <= set(commands[6])
    assert "--name=tiny-pretrained" in commands[9]


def test_it_goes_on_where_it_failed_or_was_stopped(run, tmp_path):
    # What never began may change.
    run("--set=wrong=1", fails="--phase=pretrain")
    status, _, commands = run("--seed=1", fails="run/control")
    assert (status, names(commands)) == (3, ["opened", *TRAIN])
    status, told, commands = run("--seed=1", "--max_steps=5", stops="run/control")
    assert (status, names(commands)) == (0, ["opened", "train"])
    assert "--max_steps=5" in commands[1]
    assert "goes on, with more --max_steps or none" in told
    assert names(run("--seed=1")[2]) == ["opened", "train", *SCORES, *SCORES]
    assert names(run("--seed=1")[2]) == ["opened", "release", "release"]
    # Scores of weights that are newer are made again.
    weights = tmp_path / "run" / "meta" / "weights.safetensors"
    future = weights.stat().st_mtime + 1000
    os.utime(weights, (future, future))
    assert names(run("--seed=1")[2]) == ["opened", *SCORES, "release"]
    status, told, commands = run("--seed=4")
    assert (status, names(commands)) == (2, ["opened"])
    assert "was begun with other arguments; give those of arguments.txt" in told
