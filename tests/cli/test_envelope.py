"""prism-envelope around a completer that is a fake."""

import dataclasses
import functools
import io
import json
import pathlib
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from experiments.simulation.recorder import write_frame
from prism_jax.assets import asset
from prism_jax.cli import envelope
from prism_jax.data.recordings import DEPTH_SCALE, RecordedCells
from prism_jax.envelope.files import NAMES
from prism_jax.envelope.robot import of_robot, robot_surface
from prism_jax.io.depth import read_camera
from prism_jax.io.ply import ply_bytes, read_ply
from prism_jax.registration.evidence import Evidence, Match
from prism_jax.registration.library import Found, Model
from prism_jax.registration.surface import FEW, surface_of
from prism_jax.robots.urdf import Linkage
from tests import launching
from tests.experiments.simulation.roboarm.conftest import urdf
from tests.fake_completer import FakeCompleter

__all__ = ["urdf"]

FRAME = asset("roboarm") / "000-panda" / "000000"
SENSOR = "--sensor=camera 640x480, 70x55 degrees"
DEPTH = "--input=depth"
BOX, VOXEL = "--workspace=-1,-1,0,1,1,2", "--voxel=0.15"


@pytest.fixture(autouse=True, scope="module")
def fake():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envelope, "load_completer", lambda weights: FakeCompleter())
        yield


def nine_cells(root, frames):
    """Copies of frames in turn, each without one more of its points."""
    for number in range(9):
        frame = frames[number % len(frames)]
        folder = root / f"{number:03d}-panda"
        shutil.copytree(frame.parent, folder)
        points = read_ply(frame.with_name("000000.partial.ply"))
        (folder / "000000.partial.ply").write_bytes(ply_bytes(points[number:]))
    return root


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return nine_cells(tmp_path_factory.mktemp("recordings"), [FRAME])


@pytest.fixture(scope="module")
def calibrated(recordings, tmp_path_factory):
    """The flag of a calibration with these flags, made once."""
    folder = tmp_path_factory.mktemp("calibrations")

    @functools.cache
    def make(*flags, cells=recordings):
        path = folder / f"{len(list(folder.iterdir()))}.json"
        words = "calibrate", str(cells), f"--output={path}", VOXEL
        assert launching.run(envelope, *words, *flags) == 0
        return f"--calibration={path}"

    return make


@pytest.fixture
def asked(calibrated, tmp_path):
    np.save(tmp_path / "query.npy", np.array([[0.0, 0, 5], [np.nan] * 3, [0.4, 0, 1]]))
    return [
        f"{FRAME}.partial.ply",
        f"--depth={FRAME}.depth.png",
        f"--camera={FRAME}.camera.json",
        calibrated(),
        f"--query={tmp_path / 'query.npy'}",
        f"--output_dir={tmp_path / 'out'}",
        VOXEL,
    ]


def without(words, *prefixes):
    return [word for word in words if not word.startswith(prefixes)]


def lines_in(folder):
    return [json.loads(line) for line in (folder / envelope.LINES).open()]


def names_in(folder):
    return {path.name for path in folder.iterdir()}


def arrays_of(folder):
    with np.load(folder / "envelope.npz", allow_pickle=False) as arrays:
        return dict(arrays)


def told_of(folder):
    return json.loads((folder / "envelope.json").read_text())


def test_all_files_are_written_and_agree(asked, tmp_path, capsys):
    content = json.loads(pathlib.Path(asked[3].partition("=")[2]).read_text())
    assert content["n"] == 9 and len(content["scores"]) == 9
    assert content["settings"]["robot"] is None and content["unit"] == "m"
    assert content["q"] == max(content["scores"]) > 0
    assert launching.run(envelope, *asked) == 0
    out = tmp_path / "out"
    assert names_in(out) == {*NAMES}
    told, arrays = told_of(out), arrays_of(out)
    assert "People are never predicted" in told["notice"]
    said = capsys.readouterr()
    assert "Not safety-rated" in said.out and "1 points are not finite" in said.err
    assert told_of(tmp_path / "out")["query_not_finite"] == 1
    state, voxel = arrays["state"], float(arrays["voxel"])
    assert state.shape == tuple(told["grid"]["shape"])
    marked = {str(n): state == i for i, n in enumerate(arrays["states"])}
    for name, where in (marked | {"envelope": arrays["envelope"]}).items():
        volume = where.sum() * voxel**3
        assert told["volumes"][name] == pytest.approx(volume)
    assert told["volumes"]["free"] > 0 and told["volumes"]["unseen"] > 0
    assert ((arrays["not_free"] > 0) == (state == 4)).all()
    measured = read_ply(FRAME.with_name("000000.partial.ply"))
    np.testing.assert_array_equal(arrays["measured"][: len(measured)], measured)
    count = len(measured) + np.count_nonzero(RecordedCells.bundled().read(0).depth)
    assert len(arrays["measured"]) == told["points"]["measured"] == count
    assert arrays["query_surface"].shape == (2,)
    assert len(read_ply(out / "envelope.ply")) == (state != 4).sum()
    solid = trimesh.load(io.BytesIO((out / "envelope.stl").read_bytes()), "stl")
    assert solid.is_watertight and solid.volume > 0
    page = (out / "envelope.html").read_text()
    assert "Not safety-rated" in page and f"q = {told['q']:.3g}" in page
    assert told["query"]["nearest_not_known_to_be_free"] == 0
    assert told["query"]["in_free_space"] == (arrays["query_not_free"] > 0).sum()


def test_a_known_part_is_told_with_its_own_margin(asked, tmp_path, monkeypatch):
    box = trimesh.creation.box((0.4, 0.2, 0.2))
    own = np.asarray(box.vertices), np.asarray(box.faces)
    model = Model("box", *own, surface_of(*own))
    match = Match(np.eye(4), np.zeros((6, 6)), 0.001, Evidence(*7 * [1.0]))

    class Knowing(FakeCompleter):
        def complete(self, *given, **asked):
            found = Found(model, match, (), {})
            return dataclasses.replace(super().complete(*given, **asked), known=found)

    monkeypatch.setattr(envelope, "load_completer", lambda weights: Knowing())
    assert launching.run(envelope, *asked) == 0
    told, arrays = told_of(tmp_path / "out"), arrays_of(tmp_path / "out")
    assert told["known"]["model"] == "box" and len(arrays["part"]) == FEW
    assert told["part_margin"] == arrays["part_margin"] == pytest.approx(0.4 * 0.06)
    page = (tmp_path / "out" / "envelope.html").read_text()
    assert "by 0.024 m at most" in page and 'data-cloud="part"' in page


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--weights=another"], "weights"),
        (["--adapt"], "adapt False, not True"),
        (["--alpha=0.05"], "on 19 or more"),
        (["--up=y"], "calibrated for up z, not y"),
        (["--voxel=0.1"], "calibrated for voxel 0.15, not 0.1"),
        ([BOX], "calibrated for workspace None, not [-1.0, -1.0, 0.0, 1.0, 1.0, 2.0]"),
        (["--background=empty"], "background unknown, not empty"),
        (["--input=depth"], "not used by prism-envelope"),
        (["--eye=0,0,0"], "omit it"),
        (
            ["--sensor=other"],
            "unknown name 'other'; the calibration was made for",
        ),
        (["another.ply"], "expected one scan or recording, got 2"),
    ],
)
def test_what_does_not_match_is_one_line(asked, tmp_path, more, told, capsys):
    assert launching.run(envelope, *asked, *more) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert told in lines[-1] and lines[-1].startswith("prism-envelope: ")
    assert not list((tmp_path / "out").glob("*"))


def test_what_is_odd_about_image_and_camera_is_told_once(asked, tmp_path, capsys):
    counts = np.asarray(Image.open(FRAME.with_name("000000.depth.png"))).copy()
    counts[:10, :10] = 65535
    Image.fromarray(counts).save(tmp_path / "d.png")
    camera = json.loads(FRAME.with_name("000000.camera.json").read_text())
    (tmp_path / "d.json").write_text(json.dumps(camera | {"coeffs": [1], "pose": 1}))
    for words in (
        [asked[0], f"--depth={tmp_path / 'd.png'}"],
        [str(tmp_path / "d.png")],
    ):
        rest = asked[3], f"--camera={tmp_path / 'd.json'}", "--alpha=2"
        assert launching.run(envelope, *words, *rest) == 2
        told = capsys.readouterr().err
        for line in ("100 pixels of the largest value", "lens distort", "pose is not"):
            assert told.count(line) == 1


def test_what_calibrating_does_not_use_is_refused(recordings, capsys):
    for flag in ("--eye=0,0,0", "--camera=c.json", "--smallest_body=0.1"):
        assert launching.run(envelope, "calibrate", str(recordings), flag) == 2
        assert "not used by prism-envelope calibrate" in capsys.readouterr().err
    assert launching.run(envelope, "reference", str(recordings), BOX) == 2
    assert "--workspace: not used by prism-envelope ref" in capsys.readouterr().err


def test_one_recording_is_one_cell_whatever_it_is_called(tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(FRAME.parent, tmp_path / name)
    words = "calibrate", str(tmp_path), f"--output={tmp_path / 'c.json'}", "--alpha=0.5"
    assert launching.run(envelope, *words) == 2
    assert "b has a frame of a" in capsys.readouterr().err


def test_other_units_and_another_kind_of_input_are_refused(
    asked, calibrated, tmp_path, capsys
):
    (tmp_path / "mm.ply").write_bytes(ply_bytes(1000 * read_ply(asked[0])))
    kept = [*without(asked[4:], "--query"), SENSOR, "--eye=1400,0,1600"]
    words = str(tmp_path / "mm.ply"), *kept
    assert launching.run(envelope, *words, asked[3]) == 2
    assert "calibrated for input both, not cloud" in capsys.readouterr().err
    assert launching.run(envelope, *words, calibrated("--input=cloud")) == 2
    assert "m; give metres" in capsys.readouterr().err


def test_fewer_cells_than_can_tell_are_refused_at_once(tmp_path, capsys):
    words = "calibrate", str(asset("roboarm")), f"--output={tmp_path / 'cal.json'}"
    assert launching.run(envelope, *words) == 2
    assert "1 cells are too few" in capsys.readouterr().err
    assert not (tmp_path / "cal.json").exists()


def test_a_cloud_without_its_sensors_place_is_refused(stream, tmp_path, capsys):
    for source in (f"{stream[0]}/2.npy", stream[0]):
        words = source, *without(stream[1:], "--eye")
        assert launching.run(envelope, *words) == 2
        assert "its sensor's place is not known" in capsys.readouterr().err
        words = source, *without(stream[1:], "--sensor")
        assert launching.run(envelope, *words) == 2
        assert "--sensor: missing" in capsys.readouterr().err


@pytest.fixture
def stream(asked, calibrated, tmp_path):
    """Three frames of one recording, the second without a point in the workspace."""
    folder = tmp_path / "clouds"
    folder.mkdir()
    for number in range(3):
        points = read_ply(FRAME.with_name("000000.partial.ply")) + 50.0 * (number == 1)
        np.save(folder / f"{number}.npy", points)
    kept = without(asked[1:], "--depth", "--camera", "--cal")
    kept.append(calibrated("--input=cloud", BOX))
    camera = read_camera(FRAME.with_name("000000.camera.json"))
    eye = ",".join(map(str, np.asarray(camera.position).tolist()))
    return [str(folder), *kept, SENSOR, BOX, "--smallest_body=0.1", f"--eye={eye}"]


def test_each_frame_of_a_recording_has_a_line_and_the_last_its_files(
    stream, tmp_path, capsys
):
    out = tmp_path / "out"
    assert launching.run(envelope, *stream) == 0
    said = capsys.readouterr()
    assert "2 completed, 0 dropped, 1 unusable" in said.out
    assert "skipped frame 1" in said.err
    assert names_in(out) == {*NAMES, "envelope.jsonl", "stream.json"}
    report = json.loads((out / "stream.json").read_text())
    assert report["whole"] and report["remarks"] == {"unusable": 1}
    first, last = lines_in(out)
    told = told_of(out)
    assert (first["frame"], last["frame"]) == (0, 2) and told["input"]["frame"] == 2
    for name in ("volumes", "q", "query", "points", "frame_id"):
        assert first[name] == last[name] == told[name]
    arrays = (out / "envelope.npz").read_bytes()
    # A scan is taken in the same way, and what was there before is set aside.
    assert launching.run(envelope, f"{stream[0]}/2.npy", *stream[1:]) == 0
    assert names_in(out) == {*NAMES, "previous"}
    assert names_in(out / "previous") == {*NAMES, "envelope.jsonl", "stream.json"}
    assert (out / "envelope.npz").read_bytes() == arrays
    assert told_of(out)["volumes"] == told["volumes"]


def test_nothing_of_another_run_is_announced_as_new(stream, tmp_path, capsys):
    assert launching.run(envelope, *stream) == 0
    for name in ("0.npy", "2.npy"):
        (tmp_path / "clouds" / name).unlink()
    capsys.readouterr()
    assert launching.run(envelope, *stream) == 2
    said = capsys.readouterr()
    assert "written" not in said.out and "no points inside --workspace" in said.err
    assert names_in(tmp_path / "out") == {"previous", "stream.json"}


def test_depth_images_of_a_recording_are_those_of_a_scan(
    asked, calibrated, recordings, tmp_path
):
    out = tmp_path / "out"
    kept = without(asked[1:], "--depth", "--camera", "--cal")
    kept.append(calibrated("--input=depth", BOX))
    cell = str(recordings / "000-panda")
    assert launching.run(envelope, cell, "--topic=depth", *kept, BOX) == 0
    (line,) = lines_in(out)
    state = arrays_of(out)["state"]
    depth = asked[1].partition("=")[2]
    assert launching.run(envelope, depth, asked[2], *kept, BOX) == 0
    np.testing.assert_array_equal(arrays_of(out)["state"], state)
    assert line["volumes"] == told_of(out)["volumes"]


def test_a_scan_that_disagrees_with_what_stands_still_is_refused(
    asked, recordings, tmp_path, capsys
):
    path = tmp_path / "reference.ply"
    words = asked[0], *asked[1:3], f"--output={path}"
    assert launching.run(envelope, "reference", *words) == 0
    alone = path.read_bytes()
    words = str(recordings), "--topic=depth", words[-1]
    assert launching.run(envelope, "reference", *words) == 0
    assert 0.5 < len(path.read_bytes()) / len(alone) < 1.5
    given = [*asked, f"--reference={path}"]
    assert launching.run(envelope, *given) == 0
    shown = told_of(tmp_path / "out")["reference"]
    assert shown["share_seen"] > 0.99 and shown["share_moved"] < 0.001
    camera = json.loads(pathlib.Path(asked[2].partition("=")[2]).read_text())
    camera["translation"][2] += 0.1
    (tmp_path / "moved.json").write_text(json.dumps(camera))
    seen = read_ply(asked[0])
    moved = np.float32(np.asarray(camera["rotation"]).T @ [0, 0, 0.1])
    (tmp_path / "moved.ply").write_bytes(ply_bytes(seen - moved))
    given[0], given[2] = str(tmp_path / "moved.ply"), f"--camera={tmp_path}/moved.json"
    assert launching.run(envelope, *given) == 2
    assert "of it has moved or is gone" in capsys.readouterr().err


def test_a_recording_that_is_broken_off_leaves_whole_files(
    stream, tmp_path, monkeypatch
):
    class Interrupted(FakeCompleter):
        frames = 0

        def complete(self, *given, **asked):
            self.frames += 1
            if self.frames == 3:  # of which the first came twice
                raise KeyboardInterrupt
            return super().complete(*given, **asked)

    monkeypatch.setattr(envelope, "load_completer", lambda weights: Interrupted())
    assert launching.run(envelope, *stream) == 130
    out = tmp_path / "out"
    assert [line["frame"] for line in lines_in(out)] == [0]
    assert names_in(out) > {*NAMES}
    assert not json.loads((out / "stream.json").read_text())["whole"]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--depth=d.png"], "not supported for recordings"),
        (["--topic=/points"], "omit --topic"),
        (["--joints=/joint_states"], "set --urdf too"),
    ],
)
def test_what_does_not_fit_a_recording_is_one_line(
    stream, tmp_path, more, told, capsys
):
    assert launching.run(envelope, *stream, *more) == 2
    assert told in capsys.readouterr().err.strip().splitlines()[-1]
    assert not list((tmp_path / "out").glob("*"))


@pytest.fixture(scope="module")
def known(urdf, tmp_path_factory):
    """Cells with an arm before the camera, in one of two poses by turns."""
    root, frames = tmp_path_factory.mktemp("known"), []
    cell = RecordedCells.bundled().read(0)
    robot, base = Linkage(urdf), np.eye(4)
    base[:3, 3] = 0.4, -0.2, 0.9
    for yaw in (0.0, 1.0):
        pose = {"yaw": yaw, "shoulder": 0.4, "elbow": 0.3}
        surface = robot_surface(robot, pose, base, 0.002)
        pixel, z = (np.asarray(one) for one in cell.camera.pixel_of(surface))
        depth = np.append(np.where(cell.depth > 0, cell.depth, 65535).ravel(), 0)
        np.minimum.at(depth, pixel, np.rint(z / DEPTH_SCALE).astype(int))
        depth = depth[:-1].reshape(cell.depth.shape)
        joints = {"positions": pose, "base": base.tolist()}
        frame = dataclasses.replace(
            cell, depth=np.where(depth == 65535, 0, depth).astype("u2"), joints=joints
        )
        write_frame(root / f"frame-{yaw}", 0, frame)
        frames.append(root / f"frame-{yaw}" / "000000")
    return nine_cells(tmp_path_factory.mktemp("cells"), frames)


def test_a_known_robot_is_where_each_frame_says_and_needs_its_own_calibration(
    asked, known, urdf, calibrated, recordings, tmp_path, capsys
):
    robot = f"--urdf={urdf}"
    words = "calibrate", str(recordings), robot, f"--output={tmp_path / 'no.json'}"
    assert launching.run(envelope, *words) == 2
    assert "no position for joint 'yaw'" in capsys.readouterr().err
    cell = known / "000-panda" / "000000"
    joints = f"--joints={cell.with_name('000000.joints.json')}"
    own = [
        f"{cell}.partial.ply",
        f"--depth={cell}.depth.png",
        f"--camera={cell}.camera.json",
    ]
    words = [*own, *asked[3:], robot]
    assert launching.run(envelope, *words, joints) == 2
    assert "calibrated for robot None, not" in capsys.readouterr().err
    assert launching.run(envelope, *words) == 2
    assert "needs --joints" in capsys.readouterr().err
    path = tmp_path / "baseless.json"
    path.write_text(json.dumps({"positions": {"yaw": 0, "shoulder": 0, "elbow": 0}}))
    assert launching.run(envelope, *words, f"--joints={path}") == 2
    assert "the robot's base is not known" in capsys.readouterr().err
    words[3] = calibrated(robot, cells=known)
    assert launching.run(envelope, *words, joints) == 0
    # The other pose, and another base.
    other = f"--joints={known / '001-panda' / '000000.joints.json'}"
    (tmp_path / "base.json").write_text(json.dumps({"base": np.eye(4).tolist()}))
    for wrong in ([other], [joints, f"--base={tmp_path / 'base.json'}"]):
        assert launching.run(envelope, *words, *wrong) == 2
        assert "of its surface lies on measured points" in capsys.readouterr().err
    kept = [*without(asked[3:], "--cal"), calibrated(robot, BOX, DEPTH, cells=known)]
    words = [str(known), *kept, robot, BOX, "--topic=depth", "--every_frame"]
    assert launching.run(envelope, *words) == 0
    out, robots = tmp_path / "out", []
    for number in ("000000", "000001"):
        arrays = arrays_of(out / number)
        robots.append(arrays["robot"])
        assert not of_robot(arrays["predicted"], arrays["robot"]).any()
    assert robots[0].shape == robots[1].shape and len(robots[0]) > 100
    assert np.abs(robots[0] - robots[1]).max() > 0.1
    told = told_of(out / "000001")
    assert told["points"]["robot"] > 100 and told["volumes"]["robot"] > 0
    assert len(lines_in(out)) == 9
