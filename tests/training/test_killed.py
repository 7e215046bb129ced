"""Trainings that are killed, and end as if they had not been."""

import json
import os
import pathlib
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

SCRIPT = pathlib.Path(__file__).with_name("killed_runs.py")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folder of both trainings, and how the kills went."""
    folder = tmp_path_factory.mktemp("killed")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, SCRIPT, folder]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return folder, json.loads(ended.stdout)


def ended(runs, name):
    return json.loads((runs[0] / name / "ended.json").read_text())


def test_many_were_killed_in_the_middle_of_a_save(runs):
    kills = runs[1]
    assert {kill["status"] for kill in kills} == {-signal.SIGKILL}
    assert sum(kill["in_save"] for kill in kills) >= 3
    # And found different checkpoints to go on from.
    steps = [kill["step"] for kill in kills]
    assert steps == sorted(steps)
    assert len(set(steps)) >= 3


def test_variables_and_state_are_those_of_an_unbroken_training(runs):
    unbroken, killed = ended(runs, "unbroken"), ended(runs, "killed")
    for what in ("last", "best", "state"):
        assert killed[what] == unbroken[what]
    # What did best is not simply what came last.
    assert unbroken["best"] != unbroken["last"]


def test_the_log_has_every_line_once(runs):
    def logged(name):
        text = (runs[0] / name / "metrics.jsonl").read_text()
        lines = [json.loads(line) for line in text.splitlines()]
        told = ("losses", "validation")
        return {
            (line["phase"], line["step"], kind): line[kind]
            for line in lines
            for kind in told
            if kind in line
        }, len(lines)

    unbroken, count = logged("unbroken")
    assert len(unbroken) == count
    assert logged("killed") == (unbroken, count)


def test_nothing_half_written_is_left(runs):
    left = [path for path in runs[0].rglob("*") if "tmp" in path.name]
    assert not left
