"""The command that builds data sets."""

import sys

import pytest
import trimesh

from experiments import make_data
from experiments.simulation.build_dataset import BUILDERS, settings_of
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


@pytest.mark.parametrize("dataset", BUILDERS)
def test_settings_of_another_set_are_refused(dataset, capsys):
    everything = {s for name in BUILDERS for s in settings_of(name)}
    setting = min(everything - {*settings_of(dataset)})
    assert run(make_data, f"--dataset={dataset}", f"--{setting}=1") != 0
    told = f"--{setting} does not belong to --dataset={dataset}"
    captured = capsys.readouterr()
    assert told in captured.out + captured.err


@pytest.mark.parametrize("package", ["trimesh", "manifold3d", "embreex", "fpsample"])
def test_a_missing_package_is_one_line(package, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    assert run(make_data, f"--output_dir={tmp_path}") == 2
    told = f'{package}: not installed; install the extra: pip install "prism_jax['
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
