"""Recordings of simulated cells on disk."""

import json

import pytest

from experiments.assets import CELLS
from experiments.simulation.roboarm import build
from experiments.simulation.roboarm.build import build_roboarm
from experiments.simulation.roboarm.models import own_arm
from prism_jax.data.manifest import MANIFEST, hash_files
from prism_jax.data.recordings import RecordedCells, check_recordings
from prism_jax.io.errors import InputError


def test_a_build_is_recordings_with_a_manifest(model, small, tmp_path):
    build_roboarm("test", tmp_path, 2, 2, 5, 0, False, small, (model,))
    assert check_recordings(tmp_path) == 4
    assert [example.name for example in RecordedCells(tmp_path)] == [
        f"{number:03d}-boxes/{frame:06d}" for number in (0, 1) for frame in (0, 1)
    ]
    found = hash_files(tmp_path)
    assert json.loads((tmp_path / MANIFEST).read_text())["files"] == found
    assert len(set(found.values())) == len(found) - 2  # one camera a sequence


def test_own_arms_are_told_by_their_shape_and_joints(urdf, small, tmp_path):
    """A file of the same name, changed after the build was begun."""
    path, folder = tmp_path / "my robot.urdf", tmp_path / "built"

    def begin():
        arms = (own_arm(path),)
        build_roboarm("test", folder, 1, 1, 5, 0, False, small, arms)

    path.write_text(urdf.read_text())
    begin()
    assert RecordedCells(folder).frames == (("000-my_robot", "000000"),)
    begin()
    for old, new in (('size="0.16', 'size="0.18'), ('upper="2"', 'upper="1.9"')):
        path.write_text(urdf.read_text().replace(old, new))
        with pytest.raises(InputError, match=r"other settings \(arms\)"):
            begin()


def test_the_bundled_frames_are_of_todays_generator(tmp_path, monkeypatch):
    asked = []

    def note(folder, content, *more):
        asked.append(content)
        return folder

    monkeypatch.setattr(build, "build", note)
    build_roboarm("test", tmp_path)
    content = json.loads(json.dumps(asked[0]))
    manifest = json.loads((CELLS / MANIFEST).read_text())
    del manifest["files"]
    assert manifest == content | {"num_frames": 1, "num_sequences": 12}
