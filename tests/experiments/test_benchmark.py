"""The launcher: what it passes on and writes. What it measures is a stand-in."""

import json

from experiments import benchmark
from experiments.benchmarks import ops, training
from experiments.benchmarks.measure import Compiled, row
from tests import launching


def test_rows_are_printed_and_written(tmp_path, monkeypatch, capsys):
    asked = []

    def suite(preset="small"):
        asked.append(preset)
        yield row("slow", [3.0, 5.0, 4.0], "fast", [2.0], 1.5)

    monkeypatch.setattr(training, "suite", suite)
    path = tmp_path / "rows.json"
    assert launching.run(benchmark, "--suite=training", f"--output={path}") == 0
    line = "| slow | 4 ms (3 to 5) | fast | 2 ms | 2 | 1.5 | no |  |  |"
    assert line in capsys.readouterr().out
    (written,) = json.loads(path.read_text())
    assert (written["ratio"], written["holds"]) == (2.0, False)
    assert launching.run(benchmark, "--suite=training", "--of=paper") == 0
    assert asked == ["small", "paper"]


def test_operations_of_a_product():
    a, b = ops.cloud(8, 0), ops.cloud(5, 1)
    assert Compiled(lambda a, b: a @ b.T, a, b).flops == 2 * 8 * 5 * 3
