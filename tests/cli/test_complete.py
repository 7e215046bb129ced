"""The command around a completer that is a fake: what it prints, writes, and how it
ends."""

import dataclasses
import inspect
import itertools
import json
import os
import pathlib
import time

import numpy as np
import plyfile
import pytest
from PIL import Image

from prism_jax import io
from prism_jax.cli import complete
from prism_jax.cli.complete import _timed as timed
from prism_jax.cli.complete import complete_file
from prism_jax.completion.weights import available_weights
from prism_jax.io.ply import read_ply, vertices_bytes
from prism_jax.preprocessing.segmentation.scene import SegmentedScene
from prism_jax.registration import library
from prism_jax.registration.evidence import Evidence, Match
from prism_jax.registration.surface import surface_of
from prism_jax.reporting.model_card import model_card
from prism_jax.uncertainty.confidence import SCENE, Verdict
from tests import launching
from tests.fake_completer import FakeCompleter

OUT = pathlib.Path("prism_output")
FILES = ["completed.ply", "report.html", "result.json"]
POINTS = np.random.default_rng(0).uniform(1, 2, size=(200, 3)).astype(np.float32)
CAMERA = {"width": 40, "height": 30, "fx": 20, "fy": 20, "cx": 19.5, "cy": 14.5}


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
    pathlib.Path("nonsense.ply").write_bytes(b"ply\nnonsense\n")
    behind = CAMERA | {"translation": [0, 0, -9]}
    pathlib.Path("behind.json").write_text(json.dumps(behind))
    pathlib.Path("completed.ply").write_bytes(io.ply_bytes(POINTS))
    pathlib.Path("result.json").write_text(json.dumps(CAMERA | {"depth_scale": 1e-3}))
    pathlib.Path("report.html").touch()
    Image.fromarray(np.full((30, 40), 2000, np.uint16)).save("result.png")
    pathlib.Path("half.json").write_text(json.dumps({"width": 64}))
    return tmp_path


@pytest.fixture
def altered(monkeypatch):
    """``altered(change)``: every completion with what ``change(done)`` says of it; the
    list that is returned is of what they were asked."""
    plain, asked = FakeCompleter.complete, []

    def altered(change=lambda done: {}):
        def complete(self, *given, **more):
            asked.append(more)
            done = plain(self, *given, **more)
            return dataclasses.replace(done, **change(done))

        monkeypatch.setattr(FakeCompleter, "complete", complete)
        return asked

    return altered


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(complete, *arguments)


def result(folder=OUT):
    return json.loads((pathlib.Path(folder) / "result.json").read_text())


def test_completes_a_scan_without_input_the_sample(folder, monkeypatch, capsys):
    assert run("--input=scan.npy") == 0
    printed = capsys.readouterr()
    assert printed.out == (
        "confidence  unknown: these weights have no calibration\n"
        "points      200 observed, 100 added\n"
        "adaptation  off\n"
        "written     prism_output: completed.ply, result.json, report.html\n"
    )
    assert printed.err == ""
    assert sorted(os.listdir(OUT)) == FILES
    monkeypatch.setattr(complete, "asset", lambda name: folder / "more.npy")
    assert run() == 0
    assert result()["input"]["file"] == str(folder / "more.npy")


def test_every_flag_reaches_the_completion(monkeypatch):
    calls = []

    def record(input, **given):
        calls.append({"input": input, **given})
        points, losses = {"partial": 0, "completed": 0}, {"objective": [2.0, 1.0]}
        told = {"points": points, "losses": losses, "verdict": None}
        return told | {"adapt": given["adapt"], "accepted": False}

    arguments = inspect.signature(complete_file).parameters
    defaults = {name: argument.default for name, argument in arguments.items()}
    assert defaults.pop("quick")  # which is no flag
    monkeypatch.setattr(complete, "complete_file", record)
    expected = {
        "ground_truth": "b.ply",
        "camera": "c.json",
        "eye": "1,2,3",
        "workspace": "-1,-1,-1,1,1,1",
        "max_points": 1000,
        "up": "-y",
        "weights": "w",
        "adapt": True,
        "density": 0.5,
        "background": "empty",
        "objects": "one",
        "known": "parts",
        "known_unit": "mm",
        "output_dir": "d",
    }
    assert run("--input=a.ply", *(f"--{k}={v}" for k, v in expected.items())) == 0
    assert run() == 0
    assert calls == [{"input": "a.ply", **expected}, defaults]


def test_interrupted_it_ends_in_one_line_and_a_bug_is_not_hidden(monkeypatch, capsys):
    def fail(*_, faults=iter((KeyboardInterrupt, KeyError)), **__):
        raise next(faults)

    monkeypatch.setattr(complete, "complete_file", fail)
    assert run() == 130
    assert capsys.readouterr().err == "prism-complete: interrupted\n"
    with pytest.raises(KeyError):
        run()


def test_files_hold_what_the_completer_said():
    summary = complete_file("scan.npy", adapt=True)
    written = result()
    points = read_ply(OUT / "completed.ply")
    assert points.dtype == np.float32
    assert points[:200].tobytes() == POINTS.tobytes()
    assert written["points"] == {"partial": 200, "network": 100, "completed": 300}
    assert written["accepted"] is True and written["weights"] == "small"
    assert len(written["losses"]["objective"]) == 4
    assert written["loss_weights"] == {"normal": 0.5, "denoise": 0.25, "align": 0.25}
    assert {"read", "load", "complete", "run"} <= set(written["seconds"])
    assert written["scores"] is written["sigma"] is None
    assert b"sigma" not in (OUT / "completed.ply").read_bytes()
    center = written["workspace"]["center"]
    np.testing.assert_allclose(center, (POINTS.min(0) + POINTS.max(0)) / 2, rtol=1e-6)
    assert io.camera_from_dict(written["camera"]).width == 128
    del written["seconds"], summary["seconds"]
    assert written == summary


def test_errors_of_points_are_in_the_files(altered):
    expected = np.linspace(1, 2, 300)
    altered(lambda done: {"sigma": np.where(done.observed, 0.0, expected)})
    told = complete_file("scan.npy")["sigma"]
    vertex = plyfile.PlyData.read(OUT / "completed.ply")["vertex"]
    assert not vertex["sigma"][:200].any()
    np.testing.assert_allclose(vertex["sigma"][200:], expected[200:], rtol=1e-6)
    shares = np.quantile(expected[200:], [0.05, 0.5, 0.95])
    wanted = dict(zip(("q05", "median", "q95"), shares, strict=True))
    assert told == pytest.approx(wanted | {"mean": expected[200:].mean()})


def test_failure_to_write_one_file_leaves_all_of_the_last(monkeypatch):
    def full(descriptor, count=itertools.count(1)):
        if next(count) == 3:
            raise OSError(28, "No space left on device")

    complete_file("scan.npy")
    before = {path.name: path.read_bytes() for path in OUT.iterdir()}
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(io.InputError, match="No space left"):
        complete_file("more.npy")
    assert {path.name: path.read_bytes() for path in OUT.iterdir()} == before


def test_a_file_whose_name_is_no_utf_8():
    name = os.fsdecode(b"Ger\xe4t.npy")
    os.rename("scan.npy", name)
    complete_file(name)
    assert result()["input"]["file"].endswith(name)
    assert "Ger\\udce4t.npy" in (OUT / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("up", ["auto", "0,0,2", "-y"])
def test_up_is_passed_on_and_written_as_it_was_taken(up, altered):
    asked = altered()
    complete_file("scan.npy", up=up)
    told = result()["up"]
    assert told == ("-y" if up == "-y" else [0, 0, 1])
    assert up == "auto" or list(asked[0]["up"]) == list(told)


@pytest.mark.parametrize("objects", ["one", "auto"])
def test_what_the_workspace_crops_away_is_told_as_around(monkeypatch, altered, objects):
    """Of a depth image; of objects on a support too."""
    counts = np.full((30, 40), 2000, np.uint16)
    counts[:, ::7] = 1900
    Image.fromarray(counts).save("scan.png")
    text = json.dumps({**CAMERA, "depth_scale": 1e-3})
    pathlib.Path("scan.json").write_text(text)
    if objects == "auto":
        planes = FakeCompleter().split_scene(-POINTS).planes
        parted = SegmentedScene(np.repeat([0, -1], [500, 100]), planes, (500,), 100, 0)
        monkeypatch.setattr(FakeCompleter, "split_scene", lambda *_: parted)
    asked = altered()
    complete_file("scan.png", objects=objects, workspace="0,-9,-9,9,9,9")
    around = asked[0]["around"]
    assert around.shape == (600, 3) and (around[:, 0] < 0).all()


def test_workspace_crops_scan_and_ground_truth():
    np.save("truth.npy", POINTS + 0.01)
    box = "1,1,1,1.5,2,3"
    complete_file("scan.npy", workspace=box, ground_truth="truth.npy")
    written = result()
    kept = POINTS[POINTS[:, 0] <= 1.5]
    assert written["points"]["partial"] == len(kept)
    assert written["input"]["points_outside"] == 200 - len(kept)
    center = (kept.min(0) + kept.max(0)) / 2
    np.testing.assert_allclose(written["workspace"]["center"], center, rtol=1e-6)
    assert written["workspace"]["bounds"] == box
    outside = POINTS + np.float32(0.01) > [1.5, 2, 3]
    assert written["ground_truth"]["points"] == 200 - outside.any(axis=1).sum()


@pytest.mark.parametrize(
    ("trust", "flags", "asks"),
    [("fair", [], True), ("low", ["--background=empty", "--objects=one"], False)],
)
def test_says_what_to_do_about_a_doubted_scan(trust, flags, asks, altered, capsys):
    reasons = ("it strays: crop it",) + (trust == "low") * (SCENE,)
    verdict = Verdict(trust, 0.01234, reasons, {"strays": 0.2})
    altered(lambda done: {"verdict": verdict})
    assert run("--input=scan.npy", *flags) == 0
    told = capsys.readouterr()
    warning = "low confidence in this completion: it strays: crop it"
    assert (warning in told.err) == (trust == "low")
    assert ("the surroundings are unknown" in told.err) == asks
    assert ("--objects=auto may take it apart" in told.err) == (
        "--objects=one" in flags
    )
    expected = f"confidence  {trust}: expected error 0.0123, in input units"
    assert told.out.splitlines()[0] == expected and result()["unit"] == "input units"


def test_a_sensor_too_far_and_points_left_out_are_told(altered, capsys):
    altered(lambda done: {"sensor": "unknown", "left_out": 5, "capped": True})
    told = complete_file("scan.npy")
    assert told["sensor"] == "unknown" and told["input"]["points_left_out"] == 5
    said = capsys.readouterr().err
    assert "this completion: limited to 200,000 added points; --density asks" in said
    assert "the sensor hardly stood at the origin" in said
    assert "5 of 200 points are far from all others and were removed" in said
    report = (OUT / "report.html").read_text()
    assert "the origin is implausible" in report
    assert "5 removed as outliers" in report


def test_what_the_input_has_beside_positions_is_in_the_output(altered):
    """Of the points that are left."""
    left, cut = {"inside": np.arange(200) > 3}, ("points", "observed")
    altered(lambda done: left | {name: getattr(done, name)[4:] for name in cut})
    ring = np.arange(200, dtype=np.uint8)
    pathlib.Path("a.ply").write_bytes(vertices_bytes(POINTS, {"ring": ring}))
    assert complete_file("a.ply")["input"]["fields"] == ["ring"]
    vertex = plyfile.PlyData.read(OUT / "completed.ply")["vertex"]
    np.testing.assert_array_equal(vertex["ring"], [*ring[4:], *np.zeros(100)])


def test_nothing_added_is_told_and_no_object_is_a_fault(monkeypatch, altered, capsys):
    altered(lambda done: {"points": POINTS, "observed": np.ones(200, bool)})
    complete_file("scan.npy")
    assert "nothing was added: what is predicted is" in capsys.readouterr().err
    planes = FakeCompleter().split_scene(-POINTS).planes
    nothing = SegmentedScene(np.full(200, -1), planes, (), 200, 0)
    monkeypatch.setattr(FakeCompleter, "split_scene", lambda *_: nothing)
    with pytest.raises(io.InputError, match="no object: 200 points are on planes"):
        complete_file("scan.npy", output_dir="none")
    assert not os.listdir("none")


def test_says_why_nothing_was_adapted(altered, capsys):
    for change, told in (
        ({"accepted": False}, "rejected, not used"),
        ({"losses": {}}, "none, these weights use no adaptation"),
    ):
        altered(lambda done, change=change: change)
        assert run("--input=scan.npy", "--adapt") == 0
        assert f"adaptation  {told}" in capsys.readouterr().out


def test_tells_of_the_weights_that_ship(capsys):
    assert run("--weights=list") == 0
    names = [line.split()[:1] for line in capsys.readouterr().out.splitlines()]
    assert all([name] in names for name in available_weights())
    assert run("--weights=small", "--card") == 0
    assert capsys.readouterr().out == model_card("small")
    assert not OUT.exists()


HERE = "--output_dir=."
FAULTS = [
    (["--input=completed.ply", HERE], "completed.ply: this is an input; choose"),
    (["--input=missing.ply"], "missing.ply: no such file; check the path"),
    (["--input=nonsense.ply"], "nonsense.ply: not a valid PLY file"),
    (["--max_points=199"], "scan.npy: 200 points exceed the limit of 199; crop or"),
    (["--input=few.npy"], "few.npy: only 63 distinct points, at least 64"),
    (["--camera=behind.json"], "scan.npy: all points are behind the camera"),
    (["--camera=half.json"], "half.json: not a valid camera: height is missing"),
    (["--ground_truth=nan.npy"], "nan.npy: no finite points"),
    (["--workspace=1,2,3"], "--workspace: cannot read '1,2,3'; give x0,y0,z0"),
    (["--output_dir=scan.npy/out"], "scan.npy/out: cannot be written"),
    (["--input=result.png", HERE], "result.json: this is an input; choose another"),
    (["--ground_truth=completed.ply", HERE], "completed.ply: this is an input"),
    (["--camera=result.json", HERE], "result.json: this is an input"),
    (["--weights=report.html", HERE], "report.html: this is an input"),
    (["--density=nan"], "--density: not finite: nan; give a number"),
    (["--inptu=scan.npy"], "Unknown command line flag 'inptu'"),
]


@pytest.mark.parametrize(("given", "fault"), FAULTS)
def test_bad_input_ends_with_one_line_and_status_2(capsys, monkeypatch, given, fault):
    """Before the weights are loaded."""
    monkeypatch.setattr(complete, "load_completer", pytest.fail)
    given = given if given[0].startswith("--input") else ["--input=scan.npy", *given]
    assert run(*given) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    assert printed.err.startswith(f"prism-complete: {fault}") and ";" in printed.err
    assert not list(pathlib.Path().glob("prism_output/*"))


@pytest.fixture
def several(folder):
    """Two scans beside each other, and what is none of them."""
    (folder / "scans").mkdir()
    np.save(folder / "scans" / "a.npy", POINTS)
    np.save(folder / "scans" / "b.npy", POINTS + 1)
    (folder / "scans" / "notes.md").touch()


def test_several_scans_have_a_folder_each_and_an_index(several, capsys):
    assert run("scans", "scans/a.npy", "--output_dir=out") == 0
    printed = capsys.readouterr()
    folders = ["a", "a-2", "b"]
    assert sorted(os.listdir("out")) == [*folders, "index.html"]
    assert all(sorted(os.listdir(f"out/{name}")) == FILES for name in folders)
    page = pathlib.Path("out/index.html").read_text()
    assert all(f'href="{name}/report.html"' in page for name in folders)
    assert "Not completed" not in page
    assert "prism-complete: 2 of 3: scans/b.npy\n" in printed.err
    assert printed.out == "written     out: index.html and 3 folders\n"


def test_folders_have_names_of_their_own_whatever_the_scans_are_called():
    """Within the output folder, and not that of the index."""
    stems = "..", ".", "index.html", "a", "A", "a-2", os.fsdecode(b"\xe4")
    scans = [f"{number}/{stem}.npy" for number, stem in enumerate(stems)]
    for scan in scans:
        os.mkdir(scan[0])
        np.save(scan, POINTS)
    assert run(*scans, "--output_dir=out/in") == 0
    names = ["A-2", "_", "a", "a-2-2", "index.html", "index.html-2"]
    assert sorted(os.listdir("out/in")) == [*names, "scan", "scan-2"]
    assert os.listdir("out") == ["in"]


def test_a_bad_file_is_told_at_the_end_and_the_others_are_done(several, capsys):
    assert run("few.npy", "scans/a.npy", "missing.ply", "--output_dir=out") == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2].startswith("prism-complete: few.npy: only 63 distinct points")
    assert lines[-1].startswith("prism-complete: missing.ply: no such file")
    assert sorted(os.listdir("out")) == ["a", "index.html"]
    page = pathlib.Path("out/index.html").read_text()
    assert "Not completed" in page and "missing.ply: no such file" in page


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        (["few.npy", "missing.ply"], "few.npy: only 63 distinct points"),
        (["nothing"], "nothing: no scans in this folder; supported suffixes: .ply"),
        (["scans", "--ground_truth=scan.npy"], "--ground_truth: cannot be used with"),
    ],
)
def test_if_none_can_be_used_the_status_is_2(several, capsys, given, fault):
    os.mkdir("nothing")
    assert run(*given) == 2
    assert f"prism-complete: {fault}" in capsys.readouterr().err


def test_a_scene_comes_back_as_its_objects_unless_one_is_asked_for(capsys):
    """Two objects on a support."""
    clouds = [POINTS, POINTS[:150] + [10, 0, 0], POINTS[:90] - [0, 0, 5]]
    np.save("scene.npy", np.concatenate(clouds).astype(np.float32))
    assert run("--input=scene.npy") == 0
    assert capsys.readouterr().out == (
        "confidence  unknown: these weights have no calibration\n"
        "objects     2; 90 points on removed planes, 0 in no object\n"
        "points      440 observed, 175 added\n"
        "written     prism_output: completed.ply, result.json, report.html\n"
    )
    told = result()
    assert [one["points"]["partial"] for one in told["objects"]] == [200, 150]
    assert told["up_source"] == "support" and len(told["planes"]) == 1
    vertices = plyfile.PlyData.read(OUT / "completed.ply")["vertex"]
    assert np.bincount(vertices["object"] + 1).tolist() == [90, 300, 225]
    assert vertices["label"].sum() == 175
    assert (vertices["label"][:440] == 0).all()
    assert run("--input=scene.npy", "--up=0,0.6,0.8") == 0
    told = "tilted by 37 degrees against --up=0,0.6,0.8; try --up=auto"
    assert told in capsys.readouterr().err
    assert run("--input=scene.npy", "--objects=one") == 0
    assert result()["points"]["partial"] == 440 and "objects" not in result()
    assert run("--input=scene.npy", "--ground_truth=scan.npy") == 0
    assert result()["scores"]


def test_an_object_that_is_a_model_is_told(altered, monkeypatch, capsys):
    """In all that is written, with the others and why it is none of them."""
    evidence = Evidence(0.97, 0.4, 0.9, 0.01, 0.0, 0.7, 1.0)
    match = Match(2 * np.eye(4), np.eye(6), 0.1, evidence)
    refused = {
        "b.stl": "too small",
        "c.stl": "about 1,000 times too large: check units",
    }
    mesh = np.eye(3), np.arange(3)[None]
    model = library.Model("a.stl", *mesh, surface_of(*mesh))
    found = library.Found(model, match, ("d.stl",), refused)
    read = []
    monkeypatch.setattr(
        library.Library, "from_folder", lambda *given: read.append(given) or given
    )
    altered(lambda done: {"known": found})
    assert run("--input=scan.npy", "--known=parts", "--known_unit=mm") == 0
    assert read == [("parts", "mm")]
    told = capsys.readouterr().err
    assert "object 0 is a.stl or d.stl" in told
    known = result()["known"]
    assert known["model"] == "a.stl" and known["equal"] == ["d.stl"]
    assert known["pose"] == (2 * np.eye(4)).tolist() and known["refused"] == refused
    assert known["fit"] == 0.97
    label = plyfile.PlyData.read(OUT / "completed.ply")["vertex"]["label"]
    assert np.bincount(label).tolist() == [200, 0, 100]
    report = (OUT / "report.html").read_text()
    assert "a.stl or d.stl" in report and "b.stl: too small" in report
    altered(lambda done: {"known": found._replace(model=None, match=None, equal=())})
    assert run("--input=scan.npy", "--known=parts") == 0
    assert result()["known"] == {"model": None, "refused": refused}
    told = capsys.readouterr().err
    assert "object 0 is none of the models, nearest b.stl: too small" in told


def test_only_a_long_step_that_ends_is_told(capsys, monkeypatch):
    seconds = {}
    with pytest.raises(ValueError, match="x"), timed("running", "run", seconds):
        raise ValueError("x")
    assert capsys.readouterr().err == "" and not seconds
    monkeypatch.setattr("prism_jax.cli.launch.PATIENCE", 0.02)
    with timed("loading", "load", seconds):
        time.sleep(0.1)
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "prism-complete: loading ..."
    assert told[1] == f"prism-complete: ... done in {seconds['load']:.1f} s"
