import hashlib
import json
import pathlib

import pytest

from experiments.assets import CELLS
from experiments.simulation.roboarm import build
from experiments.simulation.roboarm.build import build_roboarm
from experiments.simulation.roboarm.models import own_arm
from prism_jax.data.manifest import MANIFEST
from prism_jax.data.recordings import RecordedCells, check_recordings
from prism_jax.io.errors import InputError


def digests(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def make(model, small):
    def call(folder, num_workers=0, **changes):
        sizes = {"num_sequences": 2, "num_frames": 2, "seed": 5} | changes
        return build_roboarm(
            "test",
            folder,
            num_workers=num_workers,
            progress=False,
            config=small,
            arms=(model,),
            **sizes,
        )

    return call


@pytest.fixture(scope="module")
def built(make, tmp_path_factory):
    return make(tmp_path_factory.mktemp("built") / "cells")


def test_a_build_is_recordings_with_a_manifest(built):
    assert check_recordings(built) == 4
    cells = RecordedCells(built)
    assert [example.name for example in cells] == [
        f"{number:03d}-boxes/{frame:06d}" for number in (0, 1) for frame in (0, 1)
    ]
    manifest = json.loads((built / MANIFEST).read_text())
    found = digests(built)
    del found[MANIFEST]
    assert manifest["files"] == found
    assert len(set(found.values())) == len(found) - 2  # one camera a sequence


def test_ones_own_robot_stands_in_the_cells(model, small, tmp_path):
    file = tmp_path / "my robot.urdf"
    file.write_bytes(pathlib.Path(model.urdf).read_bytes())
    folder = build_roboarm(
        "test", tmp_path / "cells", 1, 1, 5, 0, False, small, [own_arm(file)]
    )
    assert RecordedCells(folder).frames == (("000-my_robot", "000000"),)


def test_own_arms_are_told_by_their_shape_and_joints(make, urdf, small, tmp_path):
    """A file of the same name, changed after the build was begun."""
    path = tmp_path / urdf.name
    folder = tmp_path / "built"

    def begin():
        arms = (own_arm(path),)
        build_roboarm("test", folder, 1, 1, 0, 0, False, small, arms)

    path.write_text(urdf.read_text())
    begin()
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
