"""Commands are read where they are printed, and run with their outputs elsewhere."""

import pathlib
import sys

from experiments import remake, results
from tests import launching

PAGE = """
`python -m experiments.evaluate --split=test --output=docs/tables/test.json`, and

```sh
python -m experiments.make_data --dataset=roboarm --output_dir=CELLS
python -m experiments.real --data_dir=scans --output=docs/tables/real.json \\
    --picture=docs/real.png
python -m experiments.plant --data_dir=CELLS --output=docs/tables/plant.json
```
"""


def test_every_table_has_its_command():
    page = (results.ROOT / "docs" / "results.md").read_text()
    assert set(remake.commands(page)) == {path.stem for path in results.tables()}


def test_commands_run_with_what_is_given(tmp_path):
    ran = []
    unfinished = tmp_path / "unfinished"

    def run(command):
        assert command[:2] == [sys.executable, "-m"]
        ran.append(command[2:])
        output = next(word for word in command if word.startswith("--output="))
        pathlib.Path(output.partition("=")[2]).write_text("{}")
        return 1 if "experiments.real" in command else 0

    found = remake.commands(PAGE)
    assert remake.remake(found, tmp_path, {"CELLS": "mine"}, run) == ["real"]
    assert ran == [
        [
            "experiments.evaluate",
            "--split=test",
            f"--output={unfinished}/test/test.json",
        ],
        [
            "experiments.real",
            "--data_dir=scans",
            f"--output={unfinished}/real/real.json",
            f"--picture={unfinished}/real/real.png",
        ],
        [
            "experiments.plant",
            "--data_dir=mine",
            f"--output={unfinished}/plant/plant.json",
        ],
    ]
    # What failed is not taken for done.
    assert {path.stem for path in tmp_path.glob("*.json")} == {"test", "plant"}
    assert (unfinished / "real" / "real.json").exists()


def test_what_is_there_or_left_open_does_not_run(tmp_path, capsys):
    (tmp_path / "real.json").touch()
    ran = []
    remake.remake(remake.commands(PAGE), tmp_path, {}, lambda words: ran.append(words))
    assert len(ran) == 1
    said = capsys.readouterr().out
    assert "real: is there\n" in said
    assert "plant: left out; give --given=CELLS=...\n" in said


def test_a_table_that_is_none_is_named(tmp_path, capsys):
    assert launching.run(remake, f"--output_dir={tmp_path}", "--tables=tset") == 2
    assert "unknown value 'tset'" in capsys.readouterr().err
