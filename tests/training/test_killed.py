"""Trainings that are killed, and end as if they had not been."""

import json
import os
import pathlib
import signal
import subprocess
import sys

import pytest

SCRIPT = pathlib.Path(__file__).with_name("killed_runs.py")


def ended(folder):
    return json.loads((folder / "ended.json").read_text())


def logged(folder):
    """What was measured, by phase and step, and how many lines there are."""
    text = (folder / "metrics.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    measured = {
        (line["phase"], line["step"], kind): line[kind]
        for line in lines
        for kind in ("losses", "validation")
        if kind in line
    }
    return measured, len(lines)


@pytest.mark.slow
def test_a_training_that_is_killed_ends_as_an_unbroken_one(tmp_path):
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, SCRIPT, tmp_path]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    kills = json.loads(done.stdout)
    assert {kill["status"] for kill in kills} == {-signal.SIGKILL}
    assert sum(kill["in_save"] for kill in kills) >= 3
    # And found different checkpoints to go on from.
    steps = [kill["step"] for kill in kills]
    assert steps == sorted(steps)
    assert len(set(steps)) >= 3
    unbroken, killed = tmp_path / "unbroken", tmp_path / "killed"
    assert ended(killed) == ended(unbroken)
    # What did best is not simply what came last.
    assert ended(unbroken)["best"] != ended(unbroken)["last"]
    # Every line is there once, and nothing half-written is left.
    measured, count = logged(unbroken)
    assert len(measured) == count
    assert logged(killed) == (measured, count)
    assert not [path for path in tmp_path.rglob("*") if "tmp" in path.name]
