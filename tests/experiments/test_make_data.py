"""The command that builds data sets."""

import trimesh

from experiments import make_data
from prism_jax.data.datasets import open_dataset
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
