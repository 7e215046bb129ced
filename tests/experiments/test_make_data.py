"""The commands that build data sets, and what a training then opens."""

import trimesh

from experiments import make_data, pack
from experiments.assets import CELLS
from prism_jax.data.datasets import open_dataset
from prism_jax.data.recordings import RecordedCells
from tests.launching import run


def test_shapes_with_settings_of_their_own(tmp_path, capsys):
    settings = ["--num_shapes=1", "--num_views=2", "--seed=3", "--num_workers=0"]
    assert run(make_data, "--split=test", *settings, f"--output_dir={tmp_path}") == 0
    assert str(tmp_path / "shapes-test") in capsys.readouterr().out
    assert len(open_dataset("shapes", "test", tmp_path)) == 2


def test_meshes_become_a_packed_set(tmp_path, capsys):
    trimesh.creation.icosphere(2).export(tmp_path / "ball.ply")
    given = [f"--mesh_dir={tmp_path}", "--dataset=meshes", "--num_workers=0"]
    assert run(make_data, *given) == 2
    assert "set --mesh_dir to the folder of meshes, and" in capsys.readouterr().err
    assert run(make_data, *given, f"--output_dir={tmp_path / 'built'}") == 0
    source = open_dataset("packed", "train", tmp_path / "built")
    assert [example.name for example in source] == ["meshes/ball.ply"]


def test_a_split_is_packed_once(tmp_path, capsys):
    place = ["--dataset=recordings", f"--data_dir={CELLS}", "--num_workers=0"]
    place += ["--num_partial=32", "--limit=2", f"--output_dir={tmp_path}"]
    train = *place, "--split=train", "--num_complete=64"
    assert run(pack, *train) == 0
    assert str(tmp_path / "train") in capsys.readouterr().out
    source = open_dataset("packed", "train", tmp_path)
    assert len(source) == 2
    assert source[0].partial.shape == (32, 3)
    assert source[1].name == f"recordings/{RecordedCells(CELLS)[11].name}"
    before = {path: path.stat().st_mtime_ns for path in source.root.iterdir()}
    assert run(pack, *train) == 0
    assert before == {path: path.stat().st_mtime_ns for path in source.root.iterdir()}
    assert run(pack, *place, "--split=train", "--num_complete=32") == 2
    assert "other settings (num_complete)" in capsys.readouterr().err
    assert run(pack, *place, "--split=validation") == 2
    assert "recordings: no validation split; use" in capsys.readouterr().err
