import hashlib
import json
import pathlib
import shutil

import pytest

from experiments.assets import CELLS
from experiments.simulation.roboarm import build
from experiments.simulation.roboarm.build import build_roboarm, copy_first_frames
from experiments.simulation.roboarm.models import ArmModel, own_arm
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


def test_bytes_do_not_depend_on_the_number_of_workers(make, built, tmp_path):
    assert digests(make(tmp_path / "two", num_workers=2)) == digests(built)


def test_another_seed_gives_other_frames(make, built, tmp_path):
    other = digests(make(tmp_path / "other", num_sequences=1, num_frames=1, seed=6))
    assert not set(other.values()) & set(digests(built).values())


def test_an_interrupted_build_goes_on(make, built, tmp_path, monkeypatch):
    folder, write, written = tmp_path / "cells", build.write_frame, []

    def stop_at_the_third(sequence, number, frame):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(number)
        write(sequence, number, frame)

    monkeypatch.setattr(build, "write_frame", stop_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        make(folder)
    with pytest.raises(InputError, match="not finished"):
        RecordedCells(folder)
    # As if the power had failed while the second frame was written.
    (folder / "000-boxes" / "000001.camera.json").unlink()
    monkeypatch.setattr(build, "write_frame", write)
    assert digests(make(folder)) == digests(built)


def test_a_finished_build_is_left_alone(make, built, monkeypatch):
    monkeypatch.setattr(build, "write_frame", None)
    assert make(built) == built


def test_builds_are_never_mixed(make, built, tmp_path):
    with pytest.raises(InputError, match=r"other settings \(seed\)"):
        make(built, seed=6)
    (tmp_path / "letter.txt").write_text("kept")
    with pytest.raises(InputError, match="not empty"):
        make(tmp_path)
    (tmp_path / MANIFEST).write_text("[]")
    with pytest.raises(InputError, match="not a manifest"):
        make(tmp_path)


def test_senseless_sizes_and_missing_robots_are_refused_first(small, tmp_path, make):
    with pytest.raises(InputError, match="one or more"):
        make(tmp_path / "a", num_frames=0)
    gone = ArmModel("gone", "test", str(tmp_path / "gone.urdf"))
    with pytest.raises(InputError, match="no such file"):
        build_roboarm("test", tmp_path / "b", config=small, arms=(gone,))
    with pytest.raises(InputError, match="unknown value"):
        build_roboarm("dev", tmp_path / "c")
    assert not list(tmp_path.iterdir())


def test_first_frames_are_a_set_of_their_own(built, tmp_path):
    copied = copy_first_frames(built, tmp_path / "first")
    cells = RecordedCells(copied)
    assert [name for name, _ in cells.frames] == ["000-boxes", "001-boxes"]
    whole, part = digests(built), digests(copied)
    del part[MANIFEST]
    assert part == {name: whole[name] for name in part} and len(part) == 12
    with pytest.raises(InputError, match="not empty"):
        copy_first_frames(built, copied)


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


def test_a_frame_that_lost_a_file_is_not_taken_for_whole(make, built, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(built, folder)
    lost = next(folder.rglob("*.complete.ply"))
    lost.unlink()
    with pytest.raises(InputError, match=r"complete\.ply: is missing from what was"):
        make(folder)
    with pytest.raises(InputError, match="is missing and in the manifest"):
        RecordedCells(folder)


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
