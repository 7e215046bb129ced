"""The job, around a completer that is a fake."""

import dataclasses
import itertools
import json
import os
import pathlib
import shutil
import time

import numpy as np
import pytest

from prism_jax import completion_job, io, metrics
from prism_jax.completion_job import CompletionJob, plain, run_job, scores, stage
from prism_jax.io.ply import read_ply
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    load = FakeCompleter.from_pretrained
    monkeypatch.setattr(completion_job, "load_completer", load)


@pytest.fixture
def job(tmp_path):
    np.save(tmp_path / "scan.npy", POINTS)
    np.save(tmp_path / "truth.npy", POINTS + 0.01)
    return CompletionJob(
        input=str(tmp_path / "scan.npy"), output_dir=str(tmp_path / "out")
    )


def outputs(job):
    folder = io.make_output_dir(job.output_dir)
    return folder, json.loads((folder / "result.json").read_text())


def replace(job, **changes):
    return CompletionJob(**(vars(job) | changes))


def test_writes_three_files_and_nothing_else(job):
    summary = run_job(job)
    folder, written = outputs(job)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["completed.ply", "report.html", "result.json"]
    assert written.pop("seconds").keys() < summary.pop("seconds").keys()
    assert written == summary


def test_a_file_whose_name_is_no_utf_8(job, tmp_path):
    name = os.fsdecode(b"Ger\xe4t.npy")
    shutil.copyfile(job.input, tmp_path / name)
    run_job(replace(job, input=str(tmp_path / name)))
    folder, written = outputs(job)
    assert written["input"]["file"].endswith(name)
    assert "Ger\\udce4t.npy" in (folder / "report.html").read_text(encoding="utf-8")


def test_measured_points_come_back_bit_for_bit(job):
    run_job(job)
    folder, written = outputs(job)
    points = read_ply(folder / "completed.ply")
    assert points.dtype == np.float32
    assert points[:300].tobytes() == POINTS.tobytes()
    assert written["points"] == {
        "observed": 300,
        "completed": 150,
        "network_output": 150,
    }


def test_result_holds_what_the_completer_said(job):
    run_job(job)
    _, written = outputs(job)
    assert written["accepted"] is True
    assert written["weights"] == "small"
    assert len(written["losses"]["objective"]) == 4
    assert written["loss_weights"] == {"normal": 0.5, "denoise": 0.25, "align": 0.25}
    assert written["seconds"]["compile"] == 12.5
    assert {"read", "load", "complete", "run"} <= set(written["seconds"])
    assert written["metrics"] is None
    center = written["workspace"]["center"]
    np.testing.assert_allclose(center, (POINTS.min(0) + POINTS.max(0)) / 2, rtol=1e-6)
    assert io.camera_from_dict(written["camera"]).width == 128


def test_workspace_crops_scan_and_ground_truth(job, tmp_path):
    truth = str(tmp_path / "truth.npy")
    run_job(replace(job, workspace="1,1,1,1.5,2,3", ground_truth=truth))
    _, written = outputs(job)
    kept = POINTS[POINTS[:, 0] <= 1.5]
    assert written["points"]["observed"] == len(kept)
    assert written["input"]["points_outside"] == 300 - len(kept)
    center = (kept.min(0) + kept.max(0)) / 2
    np.testing.assert_allclose(written["workspace"]["center"], center, rtol=1e-6)
    assert written["workspace"]["bounds"] == "1,1,1,1.5,2,3"
    outside = POINTS + np.float32(0.01) > [1.5, 2, 3]
    assert written["ground_truth"]["points"] == 300 - outside.any(axis=1).sum()


def test_up_is_passed_on_and_written(job, monkeypatch):
    asked = []
    complete = FakeCompleter.complete

    def spy(self, *args, up="z", **kwargs):
        asked.append(up)
        return complete(self, *args, **kwargs)

    monkeypatch.setattr(FakeCompleter, "complete", spy)
    for up in (None, "-y"):
        run_job(replace(job, up=up))
        _, written = outputs(job)
        assert written["up"] == asked[-1] == (up or "z")


def test_scores_are_in_workspace_units(job):
    result = FakeCompleter().complete(POINTS)
    truth = POINTS + np.float32(0.01)
    measured = scores(result, truth)
    center, half = result.workspace.center, result.workspace.half_extent
    clouds = {
        "partial": POINTS,
        "network_output": result.prediction,
        "completed": result.points,
    }
    for name, cloud in clouds.items():
        pair = (cloud.astype(np.float64) - center) / half, (truth - center) / half
        assert measured[name] == {
            "cd_l1": metrics.cd_l1(*pair),
            "cd_l2": metrics.cd_l2(*pair),
            "f_score": metrics.f_score(*pair, 0.01),
            "hausdorff": metrics.hausdorff(*pair),
        }
    assert measured["partial"]["cd_l1"] == pytest.approx(0.01 / half * 3**0.5, rel=0.2)


def test_scores_of_huge_clouds_are_of_an_even_sample(monkeypatch):
    result = FakeCompleter().complete(POINTS)
    monkeypatch.setattr(completion_job, "MAX_SCORED_POINTS", 100)
    measured = scores(result, POINTS)
    assert measured["max_points"] == 100
    assert measured == scores(result, POINTS)
    assert measured["partial"]["cd_l1"] == 0.0


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_failure_to_write_one_file_leaves_all_of_the_last(job, monkeypatch, nth):
    def files():
        folder = pathlib.Path(job.output_dir)
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    def full(descriptor, count=itertools.count(1)):
        if next(count) == nth:
            raise OSError(28, "No space left on device")

    run_job(job)
    before = files()
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(io.InputError, match="No space left"):
        run_job(replace(job, adapt=False))
    assert files() == before


def test_a_sensor_too_far_away_is_told(job, monkeypatch, capsys):
    run_job(job)
    assert "--camera" not in capsys.readouterr().err
    complete = FakeCompleter.complete

    def unknown(*args, **kwargs):
        return dataclasses.replace(complete(*args, **kwargs), sensor="unknown")

    monkeypatch.setattr(FakeCompleter, "complete", unknown)
    assert run_job(job)["sensor"] == "unknown"
    assert "too far away to be the sensor's place" in capsys.readouterr().err
    report = (pathlib.Path(job.output_dir) / "report.html").read_text()
    assert "the origin is too far away, or among the points" in report


def test_bad_input_is_refused_before_weights_are_loaded(job, monkeypatch):
    monkeypatch.setattr(completion_job, "load_completer", pytest.fail)
    with pytest.raises(io.InputError, match=r"truth.*no such file"):
        run_job(replace(job, ground_truth="truth.ply"))


def test_long_stage_is_told(capsys, monkeypatch):
    monkeypatch.setattr(completion_job, "PATIENCE", 0.02)
    seconds = {}
    with stage("loading", "load", seconds):
        time.sleep(0.1)
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "prism-complete: loading ...",
        f"prism-complete: ... done in {seconds['load']:.1f} s",
    ]


def test_short_stage_and_failed_stage_are_quiet(capsys):
    seconds = {}
    with stage("loading", "load", seconds):
        pass
    with pytest.raises(ValueError, match="x"), stage("running", "run", seconds):
        raise ValueError("x")
    assert capsys.readouterr().err == ""
    assert set(seconds) == {"load"}


def test_plain_is_strict_json():
    value = {
        "a": np.float32(0.5),
        "b": np.array([[1, 2]]),
        "c": (float("nan"), np.inf, None, True, "x"),
        "d": {"e": np.bool_(False), "f": np.array([np.nan, 1.0])},
    }
    expected = {
        "a": 0.5,
        "b": [[1, 2]],
        "c": [None, None, None, True, "x"],
        "d": {"e": False, "f": [None, 1.0]},
    }
    assert plain(value) == expected
    json.dumps(plain(value), allow_nan=False)
