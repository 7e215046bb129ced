"""Recordings of simulated cells on disk."""

import json

from experiments.assets import CELLS
from experiments.simulation.roboarm import build
from experiments.simulation.roboarm.build import build_roboarm
from prism_jax.data.manifest import MANIFEST, hash_files
from prism_jax.data.recordings import RecordedCells


def test_a_build_is_recordings_with_a_manifest(model, small, tmp_path):
    build_roboarm("test", tmp_path, 2, 2, 5, 0, False, small, (model,))
    assert [example.name for example in RecordedCells(tmp_path)] == [
        f"{number:03d}-boxes/{frame:06d}" for number in (0, 1) for frame in (0, 1)
    ]
    found = hash_files(tmp_path)
    assert json.loads((tmp_path / MANIFEST).read_text())["files"] == found
    assert len(set(found.values())) == len(found) - 2  # one camera a sequence


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
