"""The launcher that ships weights: what they then say of themselves."""

import json

import numpy as np
import pytest

from experiments import release
from experiments.calibrate import unfitted
from prism_jax.completion.weights import (
    file_sha256,
    load_calibration,
    load_point_errors,
    load_pretrained,
    read_metadata,
    save_weights,
    sha256,
)
from prism_jax.io.errors import InputError
from prism_jax.uncertainty.sigma import PointErrors
from tests import launching


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(release, *arguments)


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config


@pytest.fixture
def finished(tmp_path, config, minimal_variables, monkeypatch):
    """A run's file, and two results of it."""
    monkeypatch.setattr(release, "ASSETS", tmp_path)
    path = tmp_path / "run.safetensors"
    save_weights(path, config, minimal_variables, {"seed": 3, "commit": "c0ffee"})
    for split in ("test", "unseen"):
        result = {"data": "shapes", "split": split, "mean": {"cd_l2": 0.1}}
        result |= {"weights": str(path), "per_example": {"name": ["a"]}}
        result |= {"weights_sha256": file_sha256(str(path))}
        text = json.dumps(result)
        (tmp_path / f"{split}.json").write_text(text)
    return tmp_path, path


def test_arrays_stay_and_scores_come_with_them(finished, config, minimal_variables):
    folder, path = finished
    scores = [f"--scores={folder / split}.json" for split in ("test", "unseen")]
    assert run(f"--weights={path}", "--name=new", *scores, "--note=a trial") == 0
    found, variables = load_pretrained(str(folder / "new.safetensors"))
    assert found == config
    assert sha256(variables) == sha256(minimal_variables)
    about = read_metadata(str(folder / "new.safetensors"))
    assert (about["seed"], about["commit"]) == (3, "c0ffee")
    assert list(about["scores"]) == ["shapes-test", "shapes-unseen"]
    assert about["scores"]["shapes-test"]["mean"] == {"cd_l2": 0.1}
    assert "per_example" not in about["scores"]["shapes-unseen"]
    assert {found["weights"] for found in about["scores"].values()} == {"new"}
    assert about["notes"] == ["a trial"]


def test_scores_of_other_weights_are_refused(
    finished, config, minimal_variables, capsys
):
    folder, path = finished
    before = path.read_bytes()
    save_weights(path, config, minimal_variables, {"seed": 4})
    given = (f"--weights={path}", "--name=new", f"--scores={folder}/test.json")
    assert run(*given) == 2
    fault = f"made for {path}, not for the current {path}"
    assert fault in capsys.readouterr().err
    assert not (folder / "new.safetensors").exists()
    # Wherever the same file lies.
    moved = folder / "moved.safetensors"
    moved.write_bytes(before)
    assert run(f"--weights={moved}", *given[1:]) == 0


def test_a_setting_may_change(finished, config):
    folder, path = finished
    changes = ["--set=model.auxiliary.max_coordinate=3", "--set=adapt.num_steps=7"]
    assert run(f"--weights={path}", "--name=new", *changes) == 0
    found, _ = load_pretrained(str(folder / "new.safetensors"))
    assert found.model.auxiliary.max_coordinate == 3.0
    assert found.adapt.num_steps == 7
    assert found.model.backbone == config.model.backbone


def test_an_unknown_setting_ships_nothing(finished, capsys):
    folder, path = finished
    assert run(f"--weights={path}", "--name=new", "--set=model.size=3") != 0
    assert "no field 'size'" in capsys.readouterr().err
    assert not (folder / "new.safetensors").exists()


def test_a_calibration_comes_with_them(finished, minimal_variables, capsys):
    """Beside what was there, and only with weights that it is of."""
    folder, path = finished
    given = ("--note=a trial", f"--scores={folder}/test.json")
    assert run(f"--weights={path}", "--name=new", *given) == 0
    new = str(folder / "new.safetensors")
    before = read_metadata(new)
    blank = unfitted(np.random.default_rng(0).normal(size=(40, 5)))
    nodes, bounds = np.zeros((1, 1)), np.array([-9.0, 0.0])
    found = PointErrors(-3.0, nodes, nodes, np.zeros((1, 2)), bounds)
    fitted = {"calibration": blank.to_dict(), "trust": {"all": {"views": 7}}}
    fitted |= {"point_errors": found.to_dict(), "sigma": {"all": {"views": 5}}}
    result = {"weights": "w", "weights_sha256": file_sha256(new), **fitted}
    place = folder / "calibration.json"
    place.write_text(json.dumps(result))
    given = (f"--weights={new}", "--name=new", f"--calibration={place}")
    assert run(*given) == 0
    assert read_metadata(new) == {**before, **fitted}
    assert load_calibration(new).to_dict() == fitted["calibration"]
    assert load_point_errors(new).to_dict() == fitted["point_errors"]
    assert sha256(load_pretrained(new)[1]) == sha256(minimal_variables)
    assert load_calibration(str(path)) is None and load_point_errors(str(path)) is None
    place.write_text(json.dumps({**result, "weights_sha256": "0"}))
    assert run(*given) == 2
    assert "rerun it for the weights to release" in capsys.readouterr().err


def test_damaged_point_errors_are_one_line(finished, config, minimal_variables):
    _, path = finished
    save_weights(path, config, minimal_variables, {"point_errors": {"base": 1}})
    with pytest.raises(InputError, match="an estimate of points' errors needs"):
        load_point_errors(str(path))


def test_a_damaged_calibration_is_one_line(finished, config, minimal_variables):
    _, path = finished
    save_weights(path, config, minimal_variables, {"calibration": {"low": 1}})
    with pytest.raises(InputError, match="a calibration needs"):
        load_calibration(str(path))
