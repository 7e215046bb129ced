"""Real scans are scored against their true shape."""

import json

import numpy as np

from experiments import real_scans
from prism_jax.io import ply_bytes
from tests import launching
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)


def test_every_scan_is_scored(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(real_scans, "Completer", FakeCompleter)
    (tmp_path / "left.ply").write_bytes(ply_bytes(POINTS[:200]))
    (tmp_path / "right.ply").write_bytes(ply_bytes(POINTS[100:]))
    (tmp_path / "truth.ply").write_bytes(ply_bytes(POINTS))
    inputs = [f"--input={tmp_path / name}.ply" for name in ("left", "right")]
    truth, output = f"--ground_truth={tmp_path / 'truth.ply'}", tmp_path / "table.json"
    asked = [*inputs, truth, "--weights=small", f"--output={output}"]
    assert launching.run(real_scans, *asked) == 0
    rows = json.loads(output.read_text())["scans"]
    assert [(row["scan"], row["weights"], row["points"]) for row in rows] == [
        ("left", "small", 200),
        ("right", "small", 200),
    ]
    text = output.with_suffix(".md").read_text()
    assert text in capsys.readouterr().out
    partial = rows[0]["clouds"]["partial"]
    assert partial["f_score"] < 1 and partial["prediction_to_truth"] == 0
    assert f"| left, 200 points | `small` | {1e4 * partial['cd_l2']:.4g} |" in text
