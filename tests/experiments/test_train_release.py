"""From nothing to weights by one script: its commands in order, and how it goes on.

Python is a stand-in (`scripted`).
"""

import functools
import os

import pytest

from tests import launching

SCORES = ["evaluate", "evaluate", "release"]
WHOLE = ["opened", "pretrain", "meta_train", "meta_train", *SCORES, *SCORES]


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
    assert names(commands) == WHOLE
    assert commands[0] == ["opened", "shapes", "d"]
    for name, *arguments in commands[1:]:
        launching.parse(name, *arguments)
    pretrain, meta, control = commands[1:4]
    for command in (pretrain, meta, control):
        assert {*given, "--resume"} <= set(command)
    assert not [flag for flag in pretrain if flag.startswith("--weights")]
    folder = tmp_path / "run"
    start = f"--weights={folder}/pretrained/weights.safetensors"
    assert start in meta and start in control
    # The control is the same training without the method.
    changes = {flag for flag in set(meta) ^ set(control) if "workdir" not in flag}
    assert changes == {flag for flag in control if "learn_" in flag} | {
        "--set=meta.method.num_steps=0",
        "--set=meta.method.lambda_aux=0.0",
        "--set=adapt.num_steps=0",
    }
    for command in commands[4:6]:
        assert {"--dataset=shapes", "--data_dir=d", "--batch_size=2"} <= set(command)
    scores = [f"--scores={folder}/meta-shapes-{s}.json" for s in ("validation", "test")]
    assert {*scores, "--name=tiny", f"--output_dir={folder}"} <= set(commands[6])
    assert "--name=tiny-pretrained" in commands[9]


def test_other_weights_sets_and_branches(run, tmp_path):
    status, _, commands = run(
        "--weights=small",
        "--name=mine",
        "--scored=shapes",
        "--scored=roboarm=cells",
        "--branches=align",
        "--branches=align,normal",
    )
    assert status == 0
    opened = [["opened", "shapes", ""], ["opened", "roboarm", "cells"]]
    assert commands[:2] == opened
    assert "--weights=small" in commands[2]
    trainings = [command for command in commands if command[0] == "meta_train"]
    assert not [command for command in trainings if "--weights=small" in command]
    changes = "--set=meta.method.branches=('align','normal',)"
    assert changes in trainings[3]
    assert f"--workdir={tmp_path}/run/meta-align-normal" in trainings[3]
    launching.parse(*trainings[3])
    assert names(commands).count("evaluate") == 4 * 4
    released = [command for command in commands if command[0] == "release"]
    assert ["--name=mine-align-normal" in command for command in released][-1]


def test_it_goes_on_where_it_failed(run, tmp_path):
    given = ("--preset=tiny", "--seed=1")
    status, _, commands = run(*given, fails="run/control")
    assert (status, len(commands)) == (3, 4)
    _, _, commands = run(*given)
    assert names(commands) == ["opened", *WHOLE[3:]]
    assert f"--workdir={tmp_path}/run/control" in commands[1]
    _, _, commands = run(*given)
    assert names(commands) == ["opened", "release", "release"]


def test_scores_of_weights_that_are_newer_are_made_again(run, tmp_path):
    run("--preset=tiny")
    weights = tmp_path / "run" / "meta" / "weights.safetensors"
    future = weights.stat().st_mtime + 1000
    os.utime(weights, (future, future))
    _, _, commands = run("--preset=tiny")
    assert names(commands) == ["opened", *SCORES, "release"]


def test_a_bounded_run_stops_and_says_so(run):
    status, told, commands = run("--max_steps=5", stops="experiments.pretrain")
    assert (status, names(commands)) == (0, ["opened", "pretrain"])
    assert "--max_steps=5" in commands[1]
    assert "goes on, with more --max_steps or none" in told
    status, told, commands = run()
    assert (status, names(commands)) == (0, WHOLE)


def test_with_other_arguments_it_does_not_go_on(run):
    run("--seed=3", fails="experiments.meta_train")
    status, told, commands = run("--seed=4")
    assert (status, names(commands)) == (2, ["opened"])
    assert "was begun with other arguments; give those of arguments.txt" in told


def test_but_what_never_began_may_change(run):
    run("--set=wrong=1", fails="experiments.pretrain")
    assert run("--seed=4")[0] == 0


@pytest.mark.parametrize(
    ("flag", "fault"),
    [
        ("shapes", "shapes: is no flag"),
        ("--branches=align,normals", "normals is none; use normal, denoise, align"),
        ("--workdir=", "--workdir: is missing"),
        ("--scored=kitti=/nowhere", "kitti: has no split with ground truth"),
        ("--scored=pcn=/nowhere", "/nowhere"),
    ],
)
def test_a_mistake_shows_before_anything_runs(run, tmp_path, flag, fault):
    status, told, commands = run(flag)
    assert status != 0 and not commands
    assert fault in told and told.count("\n") == 1
    assert not (tmp_path / "run").exists()
