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
from prism_jax.uncertainty.sigma import PointErrors
from tests import launching


def run(path, *arguments) -> int:
    """The command's exit status, of this file's release as `new`."""
    given = f"--weights={path}", "--name=new", *arguments
    return launching.run(release, *given)


@pytest.fixture
def path(tmp_path, minimal, minimal_variables, monkeypatch):
    """A run's file, with two results of it beside it."""
    monkeypatch.setattr(release, "ASSETS", tmp_path)
    path, about = tmp_path / "run.safetensors", {"seed": 3, "commit": "c0ffee"}
    save_weights(path, minimal.config, minimal_variables, about)
    for split in ("test", "unseen"):
        result = {"data": "shapes", "split": split, "mean": {"cd_l2": 0.1}}
        result |= {"weights": str(path), "per_example": {"name": ["a"]}}
        result |= {"weights_sha256": file_sha256(str(path))}
        (tmp_path / f"{split}.json").write_text(json.dumps(result))
    return path


@pytest.fixture
def new(tmp_path):
    return tmp_path / "new.safetensors"


def test_arrays_stay_and_scores_come_with_them(path, new, minimal, minimal_variables):
    scores = [f"--scores={path.parent / split}.json" for split in ("test", "unseen")]
    changes = "--set=adapt.num_steps=7", "--note=a trial"
    assert run(path, *scores, *changes) == 0
    found, variables = load_pretrained(str(new))
    assert found == minimal.config.with_adapt(num_steps=7)
    assert sha256(variables) == sha256(minimal_variables)
    about = read_metadata(str(new))
    assert (about["seed"], about["commit"]) == (3, "c0ffee")
    assert list(about["scores"]) == ["shapes-test", "shapes-unseen"]
    assert about["scores"]["shapes-test"]["mean"] == {"cd_l2": 0.1}
    assert "per_example" not in about["scores"]["shapes-unseen"]
    assert {found["weights"] for found in about["scores"].values()} == {"new"}
    assert about["notes"] == ["a trial"]


def test_scores_of_other_weights_are_refused(
    path, new, minimal, minimal_variables, capsys
):
    before, scores = path.read_bytes(), f"--scores={path.parent}/test.json"
    save_weights(path, minimal.config, minimal_variables, {"seed": 4})
    assert run(path, scores) == 2
    fault = f"made for {path}, not for the current {path}"
    assert fault in capsys.readouterr().err
    assert run(path, "--set=model.size=3") != 0
    assert "no field 'size'" in capsys.readouterr().err and not new.exists()
    # Wherever the same file lies.
    moved = path.with_name("moved.safetensors")
    moved.write_bytes(before)
    assert run(moved, scores) == 0


def test_a_calibration_comes_with_them(path, new, minimal_variables, capsys):
    """Beside what was there, and only with weights that it is of."""
    assert run(path, "--note=a trial", f"--scores={path.parent}/test.json") == 0
    before = read_metadata(str(new))
    blank = unfitted(np.random.default_rng(0).normal(size=(40, 16)))
    nodes, bounds = np.zeros((1, 1)), np.array([-9.0, 0.0])
    found = PointErrors(-3.0, nodes, nodes, np.zeros((1, 2)), bounds)
    fitted = {"calibration": blank.to_dict(), "trust": {"all": {"views": 7}}}
    fitted |= {"point_errors": found.to_dict(), "sigma": {"all": {"views": 5}}}
    result = {"weights": "w", "weights_sha256": file_sha256(str(new)), **fitted}
    place = path.with_name("calibration.json")
    place.write_text(json.dumps(result))
    assert run(new, f"--calibration={place}") == 0
    assert read_metadata(str(new)) == {**before, **fitted}
    assert load_calibration(str(new)).to_dict() == fitted["calibration"]
    assert load_point_errors(str(new)).to_dict() == fitted["point_errors"]
    assert sha256(load_pretrained(str(new))[1]) == sha256(minimal_variables)
    assert load_calibration(str(path)) is None and load_point_errors(str(path)) is None
    place.write_text(json.dumps({**result, "weights_sha256": "0"}))
    assert run(new, f"--calibration={place}") == 2
    assert "rerun it for the weights to release" in capsys.readouterr().err
