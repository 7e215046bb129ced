"""The launcher that takes scenes apart."""

import json

import numpy as np

from experiments import segmentation
from tests import launching
from tests.experiments.simulation.scenes.conftest import scenes_dir

__all__ = ["scenes_dir"]


def write_pcd(path, points, labels) -> str:
    """A labelled scan in ASCII."""
    rows = [
        f"{label} {x} {y} {z}" for label, (x, y, z) in zip(labels, points, strict=True)
    ]
    head = f"FIELDS label x y z\nSIZE 4 4 4 4\nTYPE U F F F\nWIDTH {len(rows)}\n"
    path.write_text(f"{head}HEIGHT 1\nDATA ascii\n" + "\n".join(rows) + "\n")
    return str(path)


def tabletop() -> tuple[np.ndarray, np.ndarray]:
    """Two pyramids on a table 1 m below the sensor, which looks down."""
    x, y = np.meshgrid(np.arange(-0.5, 0.5, 0.01), np.arange(-0.5, 0.5, 0.01))
    z, label = np.ones_like(x), np.ones(x.shape, int)
    for number, place in enumerate((-0.25, 0.25)):
        height = 0.2 * (1 - np.maximum(np.abs(x - place), np.abs(y)) / 0.12)
        on = height > 0.01
        z[on], label[on] = 1 - height[on], 20 + number
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), label.ravel()


def test_scenes_and_scans_are_measured(scenes_dir, tmp_path, capsys):
    points, labels = tabletop()
    points[7] = np.nan
    scan = write_pcd(tmp_path / "table.pcd", points, labels)
    output = tmp_path / "tables" / "segmentation.json"
    place = [f"--data_dir={scenes_dir}", f"--scan={scan}", f"--output={output}"]
    assert launching.run(segmentation, *place) == 0
    result = json.loads(output.read_text())
    assert result["scenes"]["all"]["scenes"] == 3
    assert [row["scene"] for row in result["by_scene"]] == [
        "000000",
        "000001",
        "000002",
    ]
    things = sum(len(row["overlap"]) for row in result["by_scene"])
    assert result["scenes"]["all"]["things"] == things > 0
    low, high = result["scenes"]["all"]["support_recall"]["interval"]
    assert low <= result["scenes"]["all"]["support_recall"]["mean"] <= high
    text = output.with_suffix(".md").read_text()
    assert text in capsys.readouterr().out
    assert "| all | 3 |" in text and "| table |" in text


def test_a_scan_has_no_interval(scenes_dir, tmp_path):
    points, labels = tabletop()
    scan = segmentation.labelled_scan(write_pcd(tmp_path / "a.pcd", points, labels))
    np.testing.assert_array_equal(scan[1] == -1, labels == 1)
    found = segmentation.scored(*scan)
    row = segmentation.measured([segmentation.Scored("a", (), found)])
    assert row["things"] == 2 and row["well"] == {"mean": 1.0, "interval": None}
    assert row["support_recall"]["mean"] > 0.97


def test_a_scan_of_one_label_ends_in_one_line(scenes_dir, tmp_path, capsys):
    points, _ = tabletop()
    scan = write_pcd(tmp_path / "one.pcd", points, np.ones(len(points), int))
    assert (
        launching.run(segmentation, f"--data_dir={scenes_dir}", f"--scan={scan}") == 2
    )
    assert "has fewer than two labels" in capsys.readouterr().err
