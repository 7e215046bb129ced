"""From a file to completed.ply, around a completer that is a fake."""

import dataclasses
import itertools
import json
import os
import pathlib
import shutil
import time

import numpy as np
import plyfile
import pytest
from PIL import Image

from prism_jax import io
from prism_jax.cli import complete
from prism_jax.cli.complete import _timed as timed
from prism_jax.cli.complete import complete_file
from prism_jax.io.ply import read_ply
from prism_jax.preprocessing.segmentation.planes import Plane
from prism_jax.preprocessing.segmentation.scene import SegmentedScene
from tests.fake_completer import FakeCompleter

PLANE = Plane(np.array([0, 0, 1.0]), 0.0, 0.1)
POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    load = FakeCompleter.from_pretrained
    monkeypatch.setattr(complete, "load_completer", load)


@pytest.fixture
def given(tmp_path):
    np.save(tmp_path / "scan.npy", POINTS)
    np.save(tmp_path / "truth.npy", POINTS + 0.01)
    folder = str(tmp_path / "out")
    return {"input": str(tmp_path / "scan.npy"), "output_dir": folder}


def outputs(given):
    folder = io.make_output_dir(given["output_dir"])
    return folder, json.loads((folder / "result.json").read_text())


def test_writes_three_files_and_nothing_else(given):
    summary = complete_file(**given)
    folder, written = outputs(given)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["completed.ply", "report.html", "result.json"]
    assert written.pop("seconds").keys() < summary.pop("seconds").keys()
    assert written == summary


def test_a_file_whose_name_is_no_utf_8(given, tmp_path):
    name = os.fsdecode(b"Ger\xe4t.npy")
    shutil.copyfile(given["input"], tmp_path / name)
    complete_file(**given | dict(input=str(tmp_path / name)))
    folder, written = outputs(given)
    assert written["input"]["file"].endswith(name)
    assert "Ger\\udce4t.npy" in (folder / "report.html").read_text(encoding="utf-8")


def test_measured_points_come_back_bit_for_bit(given):
    complete_file(**given)
    folder, written = outputs(given)
    points = read_ply(folder / "completed.ply")
    assert points.dtype == np.float32
    assert points[:300].tobytes() == POINTS.tobytes()
    assert written["points"] == {
        "partial": 300,
        "network": 150,
        "completed": 450,
    }


def test_result_holds_what_the_completer_said(given):
    complete_file(**given, adapt=True)
    _, written = outputs(given)
    assert written["accepted"] is True
    assert written["weights"] == "small"
    assert len(written["losses"]["objective"]) == 4
    assert written["loss_weights"] == {"normal": 0.5, "denoise": 0.25, "align": 0.25}
    assert written["seconds"]["compile"] == 12.5
    assert {"read", "load", "complete", "run"} <= set(written["seconds"])
    assert written["scores"] is None
    center = written["workspace"]["center"]
    np.testing.assert_allclose(center, (POINTS.min(0) + POINTS.max(0)) / 2, rtol=1e-6)
    assert io.camera_from_dict(written["camera"]).width == 128


@pytest.mark.parametrize("objects", ["one", "auto"])
def test_what_the_workspace_crops_away_is_told_as_around(given, monkeypatch, objects):
    """Of a depth image; of objects on a support too."""
    folder = pathlib.Path(given["input"]).parent
    counts = np.full((30, 40), 2000, np.uint16)
    counts[:, ::7] = 1900
    Image.fromarray(counts).save(folder / "scan.png")
    camera = {"width": 40, "height": 30, "fx": 20, "fy": 20, "cx": 19.5, "cy": 14.5}
    text = json.dumps({**camera, "depth_scale": 1e-3})
    (folder / "scan.json").write_text(text)
    told = []
    plain = FakeCompleter.complete

    def complete(self, *arguments, around=None, **asked):
        told.append(around)
        return plain(self, *arguments, **asked)

    monkeypatch.setattr(FakeCompleter, "complete", complete)
    if objects == "auto":
        parted = SegmentedScene(
            np.repeat([0, -1], [500, 100]), (PLANE,), (500,), 100, 0
        )
        monkeypatch.setattr(FakeCompleter, "split_scene", lambda *_: parted)
    image = given | dict(input=str(folder / "scan.png"), objects=objects)
    complete_file(**image, workspace="0,-9,-9,9,9,9")
    assert told[0].shape == (600, 3) and (told[0][:, 0] < 0).all()
    if objects == "one":
        complete_file(**image)
        assert told[1] is None


def test_workspace_crops_scan_and_ground_truth(given, tmp_path):
    truth = str(tmp_path / "truth.npy")
    complete_file(**given | dict(workspace="1,1,1,1.5,2,3", ground_truth=truth))
    _, written = outputs(given)
    kept = POINTS[POINTS[:, 0] <= 1.5]
    assert written["points"]["partial"] == len(kept)
    assert written["input"]["points_outside"] == 300 - len(kept)
    center = (kept.min(0) + kept.max(0)) / 2
    np.testing.assert_allclose(written["workspace"]["center"], center, rtol=1e-6)
    assert written["workspace"]["bounds"] == "1,1,1,1.5,2,3"
    outside = POINTS + np.float32(0.01) > [1.5, 2, 3]
    assert written["ground_truth"]["points"] == 300 - outside.any(axis=1).sum()


def test_up_is_passed_on_and_written(given, monkeypatch):
    asked = []
    completed = FakeCompleter.complete

    def spy(self, *args, up="z", **kwargs):
        asked.append(up)
        return completed(self, *args, **kwargs)

    monkeypatch.setattr(FakeCompleter, "complete", spy)
    for up in (None, "-y"):
        complete_file(**given | dict(up=up))
        _, written = outputs(given)
        assert written["up"] == asked[-1] == (up or "z")


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_failure_to_write_one_file_leaves_all_of_the_last(given, monkeypatch, nth):
    def files():
        folder = pathlib.Path(given["output_dir"])
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    def full(descriptor, count=itertools.count(1)):
        if next(count) == nth:
            raise OSError(28, "No space left on device")

    complete_file(**given)
    before = files()
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(io.InputError, match="No space left"):
        complete_file(**given | dict(adapt=True))
    assert files() == before


def test_a_sensor_too_far_away_is_told(given, monkeypatch, capsys):
    complete_file(**given)
    assert "--camera" not in capsys.readouterr().err
    completed = FakeCompleter.complete

    def unknown(*args, **kwargs):
        return dataclasses.replace(completed(*args, **kwargs), sensor="unknown")

    monkeypatch.setattr(FakeCompleter, "complete", unknown)
    assert complete_file(**given)["sensor"] == "unknown"
    assert "the origin cannot be the sensor position" in capsys.readouterr().err
    report = (pathlib.Path(given["output_dir"]) / "report.html").read_text()
    assert "the origin is implausible" in report


def test_points_that_were_left_out_are_told_and_counted(given, monkeypatch, capsys):
    assert complete_file(**given)["input"]["points_left_out"] == 0
    assert "were removed" not in capsys.readouterr().err
    completed = FakeCompleter.complete

    def without_some(*args, **kwargs):
        return dataclasses.replace(completed(*args, **kwargs), left_out=5)

    monkeypatch.setattr(FakeCompleter, "complete", without_some)
    assert complete_file(**given)["input"]["points_left_out"] == 5
    told = [
        line for line in capsys.readouterr().err.splitlines() if "were removed" in line
    ]
    assert len(told) == 1
    assert "5 of 300 points are far from all others" in told[0]
    report = (pathlib.Path(given["output_dir"]) / "report.html").read_text()
    assert "5 removed as outliers" in report


def test_bad_input_is_refused_before_weights_are_loaded(given, tmp_path, monkeypatch):
    monkeypatch.setattr(complete, "load_completer", pytest.fail)
    with pytest.raises(io.InputError, match=r"truth.*no such file"):
        complete_file(**given | dict(ground_truth="truth.ply"))
    np.save(tmp_path / "point.npy", np.ones((5, 3), np.float32))
    with pytest.raises(io.InputError, match=r"point.npy.*all points coincide"):
        complete_file(**given | dict(ground_truth=str(tmp_path / "point.npy")))


def test_a_long_step_is_told(capsys, monkeypatch):
    monkeypatch.setattr("prism_jax.cli.launch.PATIENCE", 0.02)
    seconds = {}
    with timed("loading", "load", seconds):
        time.sleep(0.1)
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "prism-complete: loading ...",
        f"prism-complete: ... done in {seconds['load']:.1f} s",
    ]


def test_a_short_step_and_a_failed_one_are_quiet(capsys):
    seconds = {}
    with timed("loading", "load", seconds):
        pass
    with pytest.raises(ValueError, match="x"), timed("running", "run", seconds):
        raise ValueError("x")
    assert capsys.readouterr().err == ""
    assert set(seconds) == {"load"}


def test_errors_of_points_are_in_the_files_or_honestly_absent(given, monkeypatch):
    """A property and a summary in the input's units; none, and null."""
    assert complete_file(**given)["sigma"] is None
    path = pathlib.Path(given["output_dir"]) / "completed.ply"
    assert b"sigma" not in path.read_bytes()
    plain = FakeCompleter.complete

    def complete(self, *arguments, **asked):
        done = plain(self, *arguments, **asked)
        sigma = np.where(done.observed, 0.0, np.linspace(1, 2, len(done.points)))
        return dataclasses.replace(done, sigma=sigma)

    monkeypatch.setattr(FakeCompleter, "complete", complete)
    told = complete_file(**given)["sigma"]
    vertex = plyfile.PlyData.read(path)["vertex"]
    expected = np.linspace(1, 2, 450)[300:]
    assert not vertex["sigma"][:300].any()
    np.testing.assert_allclose(vertex["sigma"][300:], expected, rtol=1e-6)
    assert told["mean"] == pytest.approx(expected.mean())
    assert told["median"] == pytest.approx(np.median(expected))
    assert told["q05"] == pytest.approx(np.quantile(expected, 0.05))
    assert told["q95"] == pytest.approx(np.quantile(expected, 0.95))
