"""The launcher that ships weights: what they then say of themselves."""

import json

import pytest

from experiments import release
from prism_jax.weights import (
    file_sha256,
    load_pretrained,
    read_metadata,
    save_weights,
    sha256,
)
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
        result |= {"weights_sha256": file_sha256(str(path))}
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


def test_scores_of_other_weights_are_refused(finished, tiny, tiny_variables, capsys):
    folder, path = finished
    before = path.read_bytes()
    save_weights(path, tiny, tiny_variables, {"seed": 4})
    given = (f"--weights={path}", "--name=new", f"--scores={folder}/test.json")
    assert run(*given) == 2
    fault = f"scores of {path}, not of {path} as it is"
    assert fault in capsys.readouterr().err
    assert not (folder / "new.safetensors").exists()
    # Wherever the same file lies.
    moved = folder / "moved.safetensors"
    moved.write_bytes(before)
    assert run(f"--weights={moved}", *given[1:]) == 0


def test_a_setting_may_change(finished, tiny):
    folder, path = finished
    changes = ["--set=model.auxiliary.max_coordinate=3", "--set=adapt.num_steps=7"]
    assert run(f"--weights={path}", "--name=new", *changes) == 0
    config, _ = load_pretrained(str(folder / "new.safetensors"))
    assert config.model.auxiliary.max_coordinate == 3.0
    assert config.adapt.num_steps == 7
    assert config.model.backbone == tiny.model.backbone


def test_an_unknown_setting_ships_nothing(finished, capsys):
    folder, path = finished
    assert run(f"--weights={path}", "--name=new", "--set=model.size=3") != 0
    assert "no field 'size'" in capsys.readouterr().err
    assert not (folder / "new.safetensors").exists()
