"""The launcher that ships weights: what they then say of themselves."""

import json

import pytest

from experiments import release
from prism_jax.weights import load_pretrained, read_metadata, save_weights, sha256
from tests import launching


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(release, *arguments)


@pytest.fixture
def finished(tmp_path, tiny, tiny_variables, monkeypatch):
    """A run's file, and two results of it."""
    monkeypatch.setattr(release, "ASSETS", tmp_path)
    path = tmp_path / "run.safetensors"
    save_weights(path, tiny, tiny_variables, {"seed": 3, "commit": "c0ffee"})
    for split in ("test", "unseen"):
        result = {"data": "shapes", "split": split, "mean": {"cd_l2": 0.1}}
        result |= {"weights": str(path), "per_example": {"name": ["a"]}}
        text = json.dumps(result)
        (tmp_path / f"{split}.json").write_text(text)
    return tmp_path, path


def test_arrays_stay_and_scores_come_with_them(finished, tiny, tiny_variables):
    folder, path = finished
    scores = [f"--scores={folder / split}.json" for split in ("test", "unseen")]
    assert run(f"--weights={path}", "--name=new", *scores, "--note=a trial") == 0
    config, variables = load_pretrained(str(folder / "new.safetensors"))
    assert config == tiny
    assert sha256(variables) == sha256(tiny_variables)
    about = read_metadata(str(folder / "new.safetensors"))
    assert (about["seed"], about["commit"]) == (3, "c0ffee")
    assert list(about["scores"]) == ["shapes-test", "shapes-unseen"]
    assert about["scores"]["shapes-test"]["mean"] == {"cd_l2": 0.1}
    assert "per_example" not in about["scores"]["shapes-unseen"]
    assert {found["weights"] for found in about["scores"].values()} == {"new"}
    assert about["notes"] == ["a trial"]


def test_scores_of_other_weights_are_refused(finished, capsys):
    folder, path = finished
    result = json.loads((folder / "test.json").read_text()) | {"weights": "small"}
    (folder / "test.json").write_text(json.dumps(result))
    assert run(f"--weights={path}", "--name=new", f"--scores={folder}/test.json") == 2
    assert f"scores of small, not of {path}" in capsys.readouterr().err
    assert not (folder / "new.safetensors").exists()


def test_a_setting_may_change(finished, tiny):
    folder, path = finished
    changes = ["--set=model.auxiliary.max_coordinate=3", "--set=num_steps=7"]
    assert run(f"--weights={path}", "--name=new", *changes) == 0
    config, _ = load_pretrained(str(folder / "new.safetensors"))
    assert config.model.auxiliary.max_coordinate == 3.0
    assert config.num_steps == 7
    assert config.model.backbone == tiny.model.backbone


def test_an_unknown_setting_ships_nothing(finished, capsys):
    folder, path = finished
    assert run(f"--weights={path}", "--name=new", "--set=model.size=3") != 0
    assert "no field 'size'" in capsys.readouterr().err
    assert not (folder / "new.safetensors").exists()
