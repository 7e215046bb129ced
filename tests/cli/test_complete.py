"""The command: what it prints, and how it ends."""

import dataclasses
import functools
import inspect
import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import plyfile
import pytest

from prism_jax.cli import complete
from prism_jax.completion.weights import available_weights
from prism_jax.reporting.model_card import model_card
from prism_jax.uncertainty.confidence import Verdict
from tests import launching
from tests.fake_completer import FakeCompleter

LOAD_COMPLETER = complete.load_completer
ROOT = pathlib.Path(__file__).resolve().parents[2]
POINTS = np.random.default_rng(0).uniform(1, 2, size=(200, 3)).astype(np.float32)
CAMERA = {"width": 64, "height": 48, "fx": 40, "fy": 40, "cx": 31.5, "cy": 23.5}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    load = FakeCompleter.from_pretrained
    monkeypatch.setattr(complete, "load_completer", load)
    monkeypatch.setattr("prism_jax.cli.launch.PATIENCE", 600.0)
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
        "confidence  unknown: these weights have no calibration\n"
        "points      200 observed, 100 added\n"
        "adaptation  off\n"
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

    def record(input, **given):
        asked.append({"input": input, **given})
        points = {"partial": 0, "completed": 0}
        losses = {"objective": [2.0, 1.0]}
        told = {"points": points, "adapt": given["adapt"], "accepted": False}
        told |= {"verdict": None}
        return told | {"losses": losses}

    arguments = inspect.signature(complete.complete_file).parameters
    defaults = {name: argument.default for name, argument in arguments.items()}
    monkeypatch.setattr(complete, "complete_file", record)
    given = ["--input=a.ply", "--ground_truth", "b.ply", "--camera=c.json"]
    given += [
        "--workspace=-1,-1,-1,1,1,1",
        "--up=-y",
        "--weights=w",
        "--adapt",
        "--density=0.5",
        "--background=empty",
        "--objects=one",
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
        "adapt": True,
        "density": 0.5,
        "background": "empty",
        "objects": "one",
        "output_dir": "d",
    }
    assert asked == [expected, defaults]
    assert not defaults["adapt"]


def test_interrupted_it_ends_in_one_line(monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(complete, "complete_file", interrupt)
    assert run() == 130
    assert capsys.readouterr().err == "prism-complete: interrupted\n"


def test_says_how_far_to_trust():
    verdict = {"trust": "fair", "expected_error": 0.01234, "reasons": []}
    summary = {"points": {"partial": 1, "completed": 3}, "adapt": False}
    summary |= {"verdict": verdict, "losses": {"objective": [2.0]}}
    told = complete.outcome(summary, "out").splitlines()[0]
    assert told == "confidence  fair: expected error 0.0123, in input units"


@pytest.fixture
def judge(monkeypatch):
    """Gives every completion that trust."""
    plain = FakeCompleter.complete

    def judge(trust):
        verdict = Verdict(trust, 0.1, ("it strays: crop it",), {"strays": 0.2})

        def judged(*given, **asked):
            return dataclasses.replace(plain(*given, **asked), verdict=verdict)

        monkeypatch.setattr(FakeCompleter, "complete", judged)

    return judge


@pytest.mark.parametrize("trust", ["low", "fair"])
def test_warns_of_low_trust_and_says_what_to_do(trust, judge, capsys):
    judge(trust)
    assert run("--input=scan.npy") == 0
    warned = (
        "low confidence in this completion: it strays: crop it"
        in capsys.readouterr().err
    )
    assert warned == (trust == "low")


@pytest.mark.parametrize(
    ("trust", "flags", "asks"),
    [
        ("high", [], False),
        ("fair", [], True),
        ("low", [], True),
        ("low", ["--background=empty"], False),
        ("low", ["--workspace=-9,-9,-9,9,9,9"], False),
    ],
)
def test_asks_what_lies_around_a_doubted_scan(trust, flags, asks, judge, capsys):
    judge(trust)
    assert run("--input=scan.npy", *flags) == 0
    told = capsys.readouterr().err
    assert ("the surroundings are unknown" in told) == asks


def test_says_why_nothing_was_adapted():
    points = {"partial": 1, "completed": 3}
    summary = {"points": points, "adapt": True, "accepted": False, "verdict": None}
    held = complete.outcome(summary | {"losses": {"objective": [2.0]}}, "out")
    assert "none, these weights use no adaptation steps" in held
    refused = complete.outcome(summary | {"losses": {"objective": [1.0, 2.0]}}, "out")
    assert "rejected, not used" in refused
    summary["adapt"] = False
    left_out = complete.outcome(summary | {"losses": {"objective": [2.0]}}, "out")
    assert "adaptation  off" in left_out


def test_without_input_it_completes_the_sample(monkeypatch, folder):
    monkeypatch.setattr(complete, "asset", lambda name: folder / "scan.npy")
    assert run() == 0
    result = json.loads(pathlib.Path("prism_output/result.json").read_text())
    assert result["input"]["file"] == str(folder / "scan.npy")


def test_lists_the_weights_that_ship(capsys):
    assert run("--weights=list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 20
    names = [line.split()[0] for line in lines[1:] if line and line[0] != " "]
    assert names[: len(available_weights())] == list(available_weights())
    assert not os.path.exists("prism_output")


def test_tells_all_of_one_set_of_weights(capsys):
    assert run("--weights=small", "--card") == 0
    assert capsys.readouterr().out == model_card("small")
    assert not os.path.exists("prism_output")


FAULTS = [
    (["--input=missing.ply"], "missing.ply: no such file; check the path"),
    (["--input=empty.ply"], "empty.ply: empty file"),
    (["--input=nonsense.ply"], "nonsense.ply: not a valid PLY file"),
    (["--input=scan.obj"], "scan.obj: suffix '.obj' is not a point cloud"),
    (["--input=."], ".: a folder, not a scan; to complete all scans in it, give"),
    (["--input="], ": suffix ''"),
    (["--max_points=199"], "scan.npy: 200 points exceed the limit of 199; crop or"),
    (["--max_points=0"], "flag --max_points=0: 0 is not a positive integer"),
    (["--max_points=200", "--ground_truth=more.npy"], "more.npy: 263 points exceed"),
    (["--input=few.npy"], "few.npy: only 63 distinct points, at least 64"),
    (["--input=nan.npy"], "nan.npy: no finite points"),
    (["--input=point.npy"], "point.npy: zero extent"),
    (["--input=vast.npy"], "vast.npy: extent 19"),
    (["--camera=behind.json"], "scan.npy: all points are behind the camera"),
    (["--camera=missing.json"], "missing.json: no such file"),
    (["--camera=half.json"], "half.json: not a valid camera: height is missing"),
    (["--camera=scan.npy"], 'scan.npy: not JSON; write {"width":'),
    (["--ground_truth=missing.ply"], "missing.ply: no such file"),
    (["--ground_truth=nan.npy"], "nan.npy: no finite points"),
    (["--workspace=1,2,3"], "--workspace: cannot read '1,2,3'; give x0,y0,z0"),
    (["--workspace=8,8,8,9,9,9"], "scan.npy: no points inside --workspace"),
    (["--workspace="], "--workspace: cannot read ''"),
    (["--weights=huge"], "huge: no such weights; choose one of small"),
    (["--output_dir=scan.npy"], "scan.npy: cannot be written to"),
    (["--output_dir=scan.npy/out"], "scan.npy/out: cannot be written to"),
    (["--inptu=scan.npy"], "Unknown command line flag 'inptu'"),
    (["--adapt=perhaps"], "flag --adapt=perhaps"),
    (["--camera"], "Missing value for flag --camera"),
    (["--up=w"], "--up: cannot read 'w'; use one of x, y, z"),
    (["--up=0,0,0"], "--up: [0.0, 0.0, 0.0] has no direction"),
    (["--objects=two"], "flag --objects=two"),
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
    def fail(*_, **__):
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
    code = "from prism_jax.cli.complete import run; run()"
    command = [sys.executable, "-c", code, "--input=missing.ply"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=False
    )
    assert ended.returncode == 2
    assert ended.stdout == ""
    expected = "prism-complete: missing.ply: no such file; check the path\n"
    assert ended.stderr == expected


@pytest.fixture
def several(folder):
    """Two scans beside each other, and what is none of them."""
    (folder / "scans").mkdir()
    np.save(folder / "scans" / "a.npy", POINTS)
    np.save(folder / "scans" / "b.npy", POINTS + 1)
    (folder / "scans" / "notes.md").touch()
    return folder / "scans"


def test_several_scans_have_a_folder_each_and_an_index(several, capsys):
    assert run("scans", "scan.npy", "scans/a.npy", "--output_dir=out") == 0
    printed = capsys.readouterr()
    folders = ["a", "a-2", "b", "scan"]
    assert sorted(os.listdir("out")) == sorted([*folders, "index.html"])
    for name in folders:
        assert sorted(os.listdir(f"out/{name}")) == [
            "completed.ply",
            "report.html",
            "result.json",
        ]
    page = pathlib.Path("out/index.html").read_text()
    assert all(f'href="{name}/report.html"' in page for name in folders)
    assert "Not completed" not in page
    assert "prism-complete: 2 of 4: scans/b.npy\n" in printed.err
    assert printed.out == "written     out: index.html and 4 folders\n"


def test_the_weights_are_loaded_once(several, monkeypatch):
    loaded = []

    def load(name):
        loaded.append(name)
        return FakeCompleter.from_pretrained(name)

    monkeypatch.setattr(complete, "load_completer", functools.cache(load))
    assert run("scans", "scan.npy") == 0
    assert loaded == ["small"]
    assert hasattr(LOAD_COMPLETER, "cache_info")


def test_a_bad_file_is_told_at_the_end_and_the_others_are_done(several, capsys):
    assert run("few.npy", "scans", "missing.ply", "--output_dir=out") == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2].startswith("prism-complete: few.npy: only 63 distinct points")
    assert lines[-1].startswith("prism-complete: missing.ply: no such file")
    assert sorted(os.listdir("out")) == ["a", "b", "index.html"]
    page = pathlib.Path("out/index.html").read_text()
    assert "Not completed" in page and "missing.ply: no such file" in page


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        (["few.npy", "missing.ply"], "few.npy: only 63 distinct points"),
        (["nothing"], "nothing: no scans in this folder; supported suffixes: .ply"),
        (
            ["scans", "--ground_truth=scan.npy"],
            "--ground_truth: cannot be used with several",
        ),
    ],
)
def test_if_none_can_be_used_the_status_is_2(several, capsys, given, fault):
    os.mkdir("nothing")
    assert run(*given) == 2
    assert f"prism-complete: {fault}" in capsys.readouterr().err


@pytest.fixture
def scene(folder):
    """Two objects on a support."""
    clouds = [POINTS, POINTS[:150] + [10, 0, 0], POINTS[:90] - [0, 0, 5]]
    np.save(folder / "scene.npy", np.concatenate(clouds).astype(np.float32))


def test_a_scene_comes_back_as_its_objects(scene, capsys):
    assert run("--input=scene.npy", "--output_dir=out") == 0
    assert capsys.readouterr().out == (
        "confidence  unknown: these weights have no calibration\n"
        "objects     2; 90 points on removed planes, 0 in no object\n"
        "points      440 observed, 175 added\n"
        "written     out: completed.ply, result.json, report.html\n"
    )
    result = json.loads(pathlib.Path("out/result.json").read_text())
    assert [one["points"]["partial"] for one in result["objects"]] == [200, 150]
    assert result["up_source"] == "support" and len(result["planes"]) == 1
    vertices = plyfile.PlyData.read("out/completed.ply")["vertex"]
    assert np.bincount(vertices["object"] + 1).tolist() == [90, 300, 225]
    assert vertices["label"].sum() == 175
    assert (vertices["label"][:440] == 0).all()


@pytest.mark.parametrize("up", ["auto", "0,0,2", "-y"])
def test_up_is_written_as_it_was_taken(up):
    assert run("--input=scan.npy", f"--up={up}") == 0
    told = json.loads(pathlib.Path("prism_output/result.json").read_text())["up"]
    assert told == ("-y" if up == "-y" else [0, 0, 1])


def test_one_object_if_asked_for(scene):
    assert run("--input=scene.npy", "--objects=one", "--output_dir=out") == 0
    result = json.loads(pathlib.Path("out/result.json").read_text())
    assert result["points"]["partial"] == 440 and "objects" not in result
    assert run("--input=scene.npy", "--ground_truth=scan.npy", "--output_dir=b") == 0
    assert json.loads(pathlib.Path("b/result.json").read_text())["scores"]
