"""What every command shares."""

import os
import subprocess
import sys

import pytest

from experiments import evaluate, train
from tests.launching import run

STARTED = """
import os, signal, sys, threading, time, types
import prism_jax_commands as commands

def write():
    sys.modules["prism_jax.io.atomic"] = types.SimpleNamespace(WRITING=threading.Lock())
    with sys.modules["prism_jax.io.atomic"].WRITING:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
        print("whole", flush=True)
    time.sleep(60)

commands.importlib.import_module = lambda _: types.SimpleNamespace(run=lambda: {})
commands.stream()
"""


def started(call, stdout=subprocess.PIPE):
    """The status, output and errors of a command that does no more than that."""
    program = [sys.executable, "-c", STARTED.format(call)]
    ended = subprocess.run(program, stdout=stdout, stderr=subprocess.PIPE, text=True)
    return ended.returncode, ended.stdout, ended.stderr


def test_ctrl_c_ends_in_one_line_but_not_while_files_are_replaced():
    assert started("print(1)") == (0, "1\n", "")
    assert started("write()") == (130, "whole\n", "prism-stream: interrupted\n")


@pytest.mark.parametrize("length", [1, 100_000])
def test_nobody_takes_what_is_printed(length):
    reader, writer = os.pipe()
    os.close(reader)
    assert started(f"print({length} * 'a')", writer) == (1, None, "")
    os.close(writer)
    with open("/dev/full", "w") as full:
        ended = started(f"print({length} * 'a')", full)
    told = "standard output: cannot be written (No space left on device)"
    assert ended == (1, None, f"prism-stream: {told}\n")


def test_an_output_that_is_no_json_is_refused(tmp_path, capsys):
    path = tmp_path / "new" / "scores.md"
    assert run(evaluate, f"--output={path}") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.endswith("scores.md is not a .json file; use the suffix .json")
    assert not path.parent.exists()


def test_what_is_no_flag_is_refused(capsys):
    """And not dropped, as absl has it after the first of several values."""
    words = "--workdir=w", "--set", "meta.num_samples=64", "adapt.seed=1"
    assert run(train, *words) == 2
    wanted = "train: adapt.seed=1: not a flag; write flags as --name=value"
    assert capsys.readouterr().err.splitlines()[-1] == wanted
