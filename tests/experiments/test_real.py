"""Real scans of a folder are completed; what is not there is left out."""

import dataclasses
import json
import types

import numpy as np
import pytest

from experiments import real as command
from experiments.real import SPECS
from prism_jax.evaluation import metrics
from prism_jax.io import ply_bytes
from prism_jax.uncertainty.confidence import Verdict
from tests import launching
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)
CORNERS = [[0, 0, 0], [0, 1, 0], [2, 1, 0], [2, 0, 0]]
CORNERS = np.array([*CORNERS, *[[x, y, 4] for x, y, _ in CORNERS]], float)


class Completer(FakeCompleter):
    """Judges what it completes, and trusts it more where nothing is around."""

    def complete(self, *arguments, **asked):
        done = super().complete(*arguments, **asked)
        trust = {"unknown": "fair", "empty": "high"}[asked.get("background", "unknown")]
        return dataclasses.replace(done, verdict=Verdict(trust, 0.25, (), {}))


def write_pcd(path, points, labels):
    """A labelled scan in ASCII."""
    rows = [
        f"{label} {x} {y} {z}" for label, (x, y, z) in zip(labels, points, strict=True)
    ]
    head = f"FIELDS label x y z\nSIZE 4 4 4 4\nTYPE U F F F\nWIDTH {len(rows)}\n"
    path.write_text(f"{head}HEIGHT 1\nDATA ascii\n" + "\n".join(rows) + "\n")


def clutter():
    """Two things beside each other in x on a table at z = -1, as `FakeCompleter` tells
    them apart; one tenth of the first one lies with the second."""
    rng = np.random.default_rng(1)
    table = rng.uniform([0, 0, -1], [20, 9, -0.5], (700, 3))
    first = rng.uniform([1, 0, 0], [9, 9, 9], (600, 3))
    first[:60, 0] += 10
    second = rng.uniform([11, 0, 0], [19, 9, 9], (540, 3))
    labels = np.repeat([1, 30, 20], [700, 600, 540])
    return np.concatenate([table, first, second]), labels


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Real scans that are made up: no depth image, no sweep, and a capture that is
    none."""
    monkeypatch.setattr(command, "Completer", Completer)
    for name in ("bunny", "kinect", "kitti", "shapenet", "ouster"):
        (tmp_path / "real" / name).mkdir(parents=True)
    place = tmp_path / "real"
    pairs = {"scan_000": POINTS[:200], "scan_090": POINTS[100:], "complete": POINTS}
    np.savez(place / "bunny" / "pairs.npz", **pairs)
    clouds = ("bunny/raw_scan_000", "shapenet/airplane_partial_2048")
    for name in (*clouds, "shapenet/airplane_predicted_16384"):
        (place / f"{name}.ply").write_bytes(ply_bytes(POINTS))
    write_pcd(place / "kinect" / "mosd_test24.pcd", *clutter())
    write_pcd(place / "kitti" / "frame_0_car_0.pcd", POINTS, np.zeros(300, int))
    np.savetxt(place / "kitti" / "frame_0_car_0.txt", CORNERS)
    (place / SPECS[-1].file).write_bytes(b"anything")
    return place


def test_every_scan_has_a_row(folder, tmp_path, monkeypatch, capsys):
    assert launching.run(command, f"--data_dir={tmp_path}") == 2
    assert "none of the scans found" in capsys.readouterr().err.splitlines()[-1]
    output = tmp_path / "tables" / "real.json"
    assert launching.run(command, f"--data_dir={folder}", f"--output={output}") == 0
    told = capsys.readouterr()
    result = json.loads(output.read_text())
    rows = {row["scan"]: row for row in result["scans"]}
    assert len(rows) == len(result["scans"]) == 10

    row = rows["bunny, scan_000"]
    assert (row["points"], row["added"], row["objects"]) == (200, 100, 1)
    assert (row["outside"], row["strays"], row["up"]) == (0, 1, "y")
    assert row["verdicts"] == [{"trust": "fair", "expected_error": 0.25}]
    partial = row["scores"]["clouds"]["partial"]
    unit = np.ptp(POINTS, axis=0).max() / 2
    expected = metrics.score(POINTS[:200] / unit, POINTS / unit).cd_l2
    assert partial["cd_l2"] == pytest.approx(expected, rel=1e-4)
    assert "f_2" in row["scores"]["clouds"]["completed"] and "f_2" not in partial
    assert rows["bunny, raw"]["scores"] is None
    alone = rows["bunny, scan_000, alone"]
    assert (row["background"], alone["background"]) == ("unknown", "empty")
    assert alone["verdicts"] == [{"trust": "high", "expected_error": 0.25}]

    scene = rows["Kinect, cloud"]
    assert (scene["objects"], scene["strays"]) == (2, 2)
    # Ten per cent of the first are with the second: 540 of 600, and 540 of 600.
    assert scene["checks"]["overlap"] == {"thing 0": 0.9, "thing 1": 0.9}
    peer = rows["ShapeNet, airplane"]["checks"]["to_peer"]
    assert peer["partial"] == pytest.approx(0, abs=1e-12) and peer["completed"] > 0

    missing = {"Kinect, depth image", "Ouster, sweep", "Ouster, capture"}
    assert set(result["left_out"]) == missing
    (line,) = [
        s for s in told.err.splitlines() if s.startswith("skipped Ouster, sweep:")
    ]
    assert "no such file" in line
    assert "| bunny, scan_000 | 200 | 1 | 100 | 0 | 1 | fair |" in told.out

    class Astray(Completer):
        def complete(self, *arguments, **asked):
            done = super().complete(*arguments, **asked)
            beyond = np.where(done.observed[:, None], done.points, done.points + 10)
            return dataclasses.replace(done, points=beyond)

    monkeypatch.setattr(command, "FLAGS", types.SimpleNamespace(weights="small"))
    scan = command.Given(POINTS.astype(float))
    assert command.row_of(Astray(), SPECS[0], scan)["outside"] == 150
