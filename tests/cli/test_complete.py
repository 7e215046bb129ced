"""The command: what it prints, and how it ends."""

import inspect
import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from prism_jax.cli import complete
from prism_jax.weights import available_weights
from tests import launching
from tests.fake_completer import FakeCompleter

ROOT = pathlib.Path(__file__).resolve().parents[2]
POINTS = np.random.default_rng(0).uniform(1, 2, size=(200, 3)).astype(np.float32)
CAMERA = {"width": 64, "height": 48, "fx": 40, "fy": 40, "cx": 31.5, "cy": 23.5}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    load = FakeCompleter.from_pretrained
    monkeypatch.setattr(complete, "load_completer", load)
    monkeypatch.setattr(complete, "PATIENCE", 600.0)
    monkeypatch.chdir(tmp_path)
    np.save("scan.npy", POINTS)
    np.save("few.npy", POINTS[:63])
    np.save("more.npy", np.concatenate([POINTS, POINTS[:63]]))
    np.save("nan.npy", np.full((200, 3), np.nan))
    np.save("point.npy", np.ones((200, 3)))
    np.save("vast.npy", POINTS * 2e4)
    pathlib.Path("empty.ply").touch()
    pathlib.Path("nonsense.ply").write_bytes(b"ply\nnonsense\n")
    pathlib.Path("scan.obj").write_bytes(b"v 0 0 0\n")
    pathlib.Path("ahead.json").write_text(json.dumps(CAMERA))
    behind = CAMERA | {"translation": [0, 0, -9]}
    pathlib.Path("behind.json").write_text(json.dumps(behind))
    pathlib.Path("half.json").write_text(json.dumps({"width": 64}))
    return tmp_path


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(complete, *arguments)


def test_completes_a_scan(capsys):
    assert run("--input=scan.npy") == 0
    printed = capsys.readouterr()
    assert printed.out == (
        "points      200 observed, 100 added\n"
        "adaptation  accepted\n"
        "written     prism_output: completed.ply, result.json, report.html\n"
    )
    assert printed.err == ""
    assert sorted(os.listdir("prism_output")) == [
        "completed.ply",
        "report.html",
        "result.json",
    ]


def test_every_flag_reaches_the_completion(monkeypatch):
    asked = []

    def record(**given):
        asked.append(given)
        points = {"partial": 0, "completed": 0}
        losses = {"objective": [2.0, 1.0]}
        told = {"points": points, "adapt": given["adapt"], "accepted": False}
        return told | {"losses": losses}

    arguments = inspect.signature(complete.complete_file).parameters
    defaults = {name: argument.default for name, argument in arguments.items()}
    monkeypatch.setattr(complete, "complete_file", record)
    given = ["--input=a.ply", "--ground_truth", "b.ply", "--camera=c.json"]
    given += [
        "--workspace=-1,-1,-1,1,1,1",
        "--up=-y",
        "--weights=w",
        "--noadapt",
        "--density=0.5",
    ]
    given += ["--max_points=1000"]
    assert run(*given, "--output_dir=d") == 0
    assert run() == 0
    expected = {
        "input": "a.ply",
        "ground_truth": "b.ply",
        "camera": "c.json",
        "workspace": "-1,-1,-1,1,1,1",
        "max_points": 1000,
        "up": "-y",
        "weights": "w",
        "adapt": False,
        "density": 0.5,
        "output_dir": "d",
    }
    assert asked == [expected, defaults]


def test_interrupted_it_ends_in_one_line(monkeypatch, capsys):
    def interrupt(**_):
        raise KeyboardInterrupt

    monkeypatch.setattr(complete, "complete_file", interrupt)
    assert run() == 130
    assert capsys.readouterr().err == "prism-complete: interrupted\n"


def test_says_why_nothing_was_adapted():
    points = {"partial": 1, "completed": 3}
    summary = {"points": points, "adapt": True, "accepted": False}
    held = complete.outcome(summary | {"losses": {"objective": [2.0]}}, "out")
    assert "none, these weights take no step" in held
    refused = complete.outcome(summary | {"losses": {"objective": [1.0, 2.0]}}, "out")
    assert "not accepted, left out" in refused
    summary["adapt"] = False
    left_out = complete.outcome(summary | {"losses": {"objective": [2.0]}}, "out")
    assert "not asked for" in left_out


def test_without_input_it_completes_the_sample(monkeypatch, folder):
    monkeypatch.setattr(complete, "asset", lambda name: folder / "scan.npy")
    assert run() == 0
    result = json.loads(pathlib.Path("prism_output/result.json").read_text())
    assert result["input"]["file"] == str(folder / "scan.npy")


def test_lists_the_weights_that_ship(capsys):
    assert run("--weights=list") == 0
    printed = capsys.readouterr().out
    assert [line for line in printed.splitlines() if line.startswith("# ")] == [
        f"# {name}" for name in available_weights()
    ]
    assert not os.path.exists("prism_output")


FAULTS = [
    (["--input=missing.ply"], "missing.ply: no such file; check the path"),
    (["--input=empty.ply"], "empty.ply: is empty"),
    (["--input=nonsense.ply"], "nonsense.ply: is not a sound PLY file"),
    (["--input=scan.obj"], "scan.obj: has the suffix '.obj'"),
    (["--input=."], ".: has the suffix ''"),
    (["--input="], ": has the suffix ''"),
    (["--max_points=199"], "scan.npy: claims 200 points, more than 199; crop or"),
    (["--max_points=0"], "flag --max_points=0: 0 is not a positive integer"),
    (["--max_points=200", "--ground_truth=more.npy"], "more.npy: claims 263 points"),
    (["--input=few.npy"], "few.npy: has 63 distinct points, fewer than 64"),
    (["--input=nan.npy"], "nan.npy: has no finite point"),
    (["--input=point.npy"], "point.npy: has an extent of zero"),
    (["--input=vast.npy"], "vast.npy: has an extent of 19"),
    (["--camera=behind.json"], "scan.npy: has every point behind the camera"),
    (["--camera=missing.json"], "missing.json: no such file"),
    (["--camera=half.json"], "half.json: is not a camera: height is missing"),
    (["--camera=scan.npy"], "scan.npy: is not a camera"),
    (["--ground_truth=missing.ply"], "missing.ply: no such file"),
    (["--ground_truth=nan.npy"], "nan.npy: has no finite point"),
    (["--workspace=1,2,3"], "--workspace: '1,2,3' is not six finite numbers"),
    (["--workspace=8,8,8,9,9,9"], "scan.npy: has no point inside --workspace"),
    (["--workspace="], "--workspace: cannot read ''"),
    (["--weights=huge"], "huge: no such weights; choose one of small"),
    (["--output_dir=scan.npy"], "scan.npy: cannot be written to"),
    (["--output_dir=scan.npy/out"], "scan.npy/out: cannot be written to"),
    (["--inptu=scan.npy"], "Unknown command line flag 'inptu'"),
    (["--adapt=perhaps"], "flag --adapt=perhaps"),
    (["--camera"], "Missing value for flag --camera"),
    (["other.npy"], "other.npy: is no flag; write --input=other.npy"),
]


@pytest.mark.parametrize(("given", "fault"), FAULTS)
def test_bad_input_ends_with_one_line_and_status_2(capsys, given, fault):
    if not any(argument.startswith("--input") for argument in given):
        given = ["--input=scan.npy", *given]
    assert run(*given) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith(f"prism-complete: {fault}")
    assert ";" in printed.err
    assert not list(pathlib.Path().glob("prism_output/*"))


def test_a_bug_is_not_hidden(monkeypatch):
    def fail(**asked):
        raise KeyError("a bug")

    monkeypatch.setattr(complete, "complete_file", fail)
    with pytest.raises(KeyError):
        run()


def test_help_lists_the_flags(capsys):
    run("--help")
    printed = capsys.readouterr().out
    for flag in ("input", "ground_truth", "workspace", "[no]adapt", "output_dir"):
        assert f"--{flag}" in printed


def test_as_a_process():
    command = [sys.executable, "-m", "experiments.complete", "--input=missing.ply"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=False
    )
    assert ended.returncode == 2
    assert ended.stdout == ""
    expected = "prism-complete: missing.ply: no such file; check the path\n"
    assert ended.stderr == expected
