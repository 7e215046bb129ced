"""The launcher that measures how small a body free space never holds."""

import json
import pathlib

from experiments import detection
from prism_jax.assets import asset
from tests import launching

ROOT = pathlib.Path(__file__).resolve().parents[2]


def test_the_smallest_body_by_sensor_and_distance(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(detection, "DISTANCES", (1.0, 5.0))
    monkeypatch.setattr(detection, "DIAMETERS", (0.02, 0.08))
    monkeypatch.setattr(detection, "ASIDE", (0.0,))
    monkeypatch.setattr(detection, "CELLS", asset("roboarm"))  # one frame
    output = tmp_path / "found.json"
    assert launching.run(detection, "--trials=1", f"--output={output}") == 0
    lines = [line.split("|")[3:5] for line in capsys.readouterr().out.splitlines()[2:5]]
    cells = [[cell.strip() for cell in line] for line in lines]
    # A ball must span more than two and a half of the spacings, 9 and 35 mm at 1 m.
    assert cells == [["2 cm", "2 cm"], ["8 cm", "none"], ["8 cm", "none"]]
    assert json.loads(output.read_text())["held"] == 0


def test_the_page_shows_what_was_measured():
    found = json.loads((ROOT / "docs/tables/detection.json").read_text())
    assert found["held"] == 0
    assert detection.table(found["sensors"]) in (ROOT / "docs/envelope.md").read_text()
