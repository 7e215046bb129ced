"""The command that packs: what a training then opens."""

from experiments import pack
from experiments.assets import CELLS
from prism_jax.data.datasets import open_dataset
from prism_jax.data.recordings import RecordedCells
from tests import launching


def test_packs_a_split_and_does_not_do_it_twice(tmp_path, capsys):
    def run(*arguments):
        place = ["--dataset=recordings", f"--data_dir={CELLS}", "--num_workers=0"]
        place += ["--num_partial=32", "--limit=2", f"--output_dir={tmp_path}"]
        return launching.run(pack, *place, *arguments)

    train = "--split=train", "--num_complete=64"
    assert run(*train) == 0
    assert str(tmp_path / "train") in capsys.readouterr().out
    source = open_dataset("packed", "train", tmp_path)
    assert len(source) == 2
    assert source[0].partial.shape == (32, 3)
    assert source[1].name == f"recordings/{RecordedCells(CELLS)[11].name}"
    before = {path: path.stat().st_mtime_ns for path in source.root.iterdir()}
    assert run(*train) == 0
    assert before == {path: path.stat().st_mtime_ns for path in source.root.iterdir()}
    assert run("--split=train", "--num_complete=32") == 2
    assert "other settings (num_complete)" in capsys.readouterr().err
    assert run("--split=validation") == 2
    assert "recordings: no validation split; use" in capsys.readouterr().err
