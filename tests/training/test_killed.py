"""Trainings that are killed, and end as if they had not been."""

import json
import os
import pathlib
import signal
import subprocess
import sys

import pytest

SCRIPT = pathlib.Path(__file__).with_name("killed_runs.py")


def left(folder):
    """What a training ended with, and the lines that it logged, without times."""
    text = (folder / "metrics.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    kept = ("phase", "step", "losses", "validation")
    logged = [[line.get(name) for name in kept] for line in lines]
    return json.loads((folder / "ended.json").read_text()), logged


@pytest.mark.slow
def test_a_training_that_is_killed_ends_as_an_unbroken_one(tmp_path):
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, SCRIPT, tmp_path]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    statuses, in_save = zip(*json.loads(done.stdout), strict=True)
    assert set(statuses) == {-signal.SIGKILL} and sum(in_save) >= 3
    assert left(tmp_path / "killed") == left(tmp_path / "unbroken")
    assert not [path for path in tmp_path.rglob("*") if "tmp" in path.name]
