"""What the launchers' tests share."""

import os
import pathlib
import subprocess
import sys

import pytest

from experiments import paired
from experiments import scored_run as evaluation
from experiments.simulation.shapes.build import ShapesConfig, build_shapes
from prism_jax.evaluation import scoring
from tests.experiments.boxes import boxes as boxes


@pytest.fixture(scope="module", autouse=True)
def quick_scores():
    """`test_paired` has intervals of as many draws as the figures have, and
    `tests/evaluation` distances of as many points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paired, "_RESAMPLES", 50)
        for module in (scoring, evaluation):
            patch.setattr(module, "EMD_POINTS", 64)
        yield


@pytest.fixture(scope="session")
def few_shapes(tmp_path_factory):
    """A folder with eight examples to train on and two to validate with."""
    folder = tmp_path_factory.mktemp("data")
    build_shapes(ShapesConfig("train", num_shapes=8, num_views=1), folder, 0, False)
    build_shapes(ShapesConfig("validation", num_shapes=2), folder, 0, False)
    return folder


ROOT = pathlib.Path(__file__).parents[2]
STAND_IN = """#!/bin/bash
if [[ $1 == -c ]]; then
    [[ $3 == shapes || $3 == roboarm ]] || exec {python} "$@"
    echo "opened $3 $4" >> {folder}/commands.txt
    printf 'validation\\ntest\\n'
    exit
fi
echo "${{@:2}}" >> {folder}/commands.txt
[[ $* == *"$FAILS"* ]] && exit 3
[[ $* == *"$STOPS"* ]] && exit
for flag in "$@"; do
    place=${{flag#*=}}
    case $flag in
    --output=*) echo scores > "$place" ;;
    --workdir=*)
        mkdir -p "$place"
        touch "$place"/{{config.json,weights.safetensors}} ;;
    esac
done
"""


@pytest.fixture
def scripted(tmp_path):
    """``scripted(script, *arguments)``: the exit status of a script, what it tells, and
    its commands.

    Python is a stand-in that notes each command and writes the file that it would.
    """
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text(STAND_IN.format(python=sys.executable, folder=tmp_path))
    python.chmod(0o755)

    def run(script, *arguments, fails="(none)", stops="(none)"):
        noted = tmp_path / "commands.txt"
        noted.write_text("")
        path = f"{python.parent}:{os.environ['PATH']}"
        ended = subprocess.run(
            [f"experiments/{script}", *arguments],
            cwd=ROOT,
            env=os.environ | {"PATH": path, "FAILS": fails, "STOPS": stops},
            capture_output=True,
            text=True,
        )
        commands = [
            line.removeprefix("experiments.").split(" ")
            for line in noted.read_text().splitlines()
        ]
        return ended.returncode, ended.stdout + ended.stderr, commands

    return run
