"""The command that packs: what a training then opens."""

from experiments import pack
from experiments.assets import CELLS
from prism_jax.data.datasets import open_dataset
from prism_jax.data.recordings import RecordedCells
from tests import launching


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(pack, *arguments)


def test_packs_a_split_and_does_not_do_it_twice(tmp_path, capsys):
    root = CELLS
    place = ["--dataset=recordings", f"--data_dir={root}", "--split=train"]
    sizes = ["--limit=2", "--num_partial=32", "--num_complete=64", "--num_workers=0"]
    assert run(*place, *sizes, f"--output_dir={tmp_path}") == 0
    assert str(tmp_path / "train") in capsys.readouterr().out
    source = open_dataset("packed", "train", tmp_path)
    assert len(source) == 2
    assert source[0].partial.shape == (32, 3)
    assert source[1].name == f"recordings/{RecordedCells(CELLS)[11].name}"
    before = {path: path.stat().st_mtime_ns for path in source.root.iterdir()}
    assert run(*place, *sizes, f"--output_dir={tmp_path}") == 0
    assert before == {path: path.stat().st_mtime_ns for path in source.root.iterdir()}


def test_recordings_are_packed_to_train_on_and_for_nothing_else(tmp_path, capsys):
    root = CELLS
    place = ["--dataset=recordings", f"--data_dir={root}", "--limit=1"]
    where = [f"--output_dir={tmp_path}", "--num_workers=0"]
    assert run(*place, *where, "--split=train") == 0
    assert len(open_dataset("packed", "train", tmp_path)) == 1
    assert run(*place, *where, "--split=validation") == 2
    assert "recordings: no validation split; use" in capsys.readouterr().err


def test_other_sizes_are_not_mixed_in(tmp_path, capsys):
    root = CELLS
    place = ["--dataset=recordings", f"--data_dir={root}", "--split=train", "--limit=1"]
    where = [f"--output_dir={tmp_path}", "--num_workers=0"]
    assert run(*place, *where, "--num_complete=64") == 0
    assert run(*place, *where, "--num_complete=32") == 2
    assert "other settings (num_complete)" in capsys.readouterr().err
