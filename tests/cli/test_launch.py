"""What every command shares."""

import os
import signal
import subprocess
import sys
import time

from experiments import evaluate, train
from prism_jax.cli import complete
from tests.launching import run


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


def test_an_interrupt_that_a_callback_swallows_comes_again(monkeypatch, capsys):
    class Collected:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def swallow(*_, **__):
        Collected()
        time.sleep(30)

    monkeypatch.setattr(complete, "complete_file", swallow)
    assert run(complete) == 130
    assert capsys.readouterr().err == "prism-complete: interrupted\n"


INTERRUPTED_IMPORT = """
import importlib, signal
from prism_jax.cli import entry
signal.signal(signal.SIGINT, signal.SIG_DFL)
importlib.import_module = lambda _: signal.raise_signal(signal.SIGINT)
entry.stream()
"""


def test_an_interrupted_import_is_one_line():
    command = [sys.executable, "-c", INTERRUPTED_IMPORT]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (130, "prism-stream: interrupted\n")


DAMAGED = """
import functools, pathlib, sys, warnings
import jax
from prism_jax.cli import launch

def compiled():
    jax.clear_caches()
    jax.jit(lambda x: x + 1)(1.0)
    (entry,) = pathlib.Path(sys.argv[1]).glob("*_lambda*-cache")
    return entry

jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
warnings.showwarning = functools.partial(launch._warned, "x", set())
compiled().write_bytes(b"damaged")
assert compiled().stat().st_size > 100
"""


def test_a_damaged_entry_of_the_cache_is_told_and_made_anew(tmp_path):
    command = [sys.executable, "-c", DAMAGED, str(tmp_path)]
    place = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    ended = subprocess.run(command, capture_output=True, text=True, env=place)
    wanted = "x: damaged programs in the cache are compiled again\n"
    assert (ended.returncode, ended.stderr) == (0, wanted)


def test_help_lists_the_flags_of_all_modules(capsys):
    assert run(train, "--help") == 0
    told = capsys.readouterr().out
    assert "Trains a preset" in told and "--workdir" in told
    assert "--phase" in told and "--mixture" in told
