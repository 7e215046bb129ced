"""prism-envelope around a completer that is a fake."""

import io
import json
import shutil

import numpy as np
import pytest
import trimesh

from prism_jax.assets import asset
from prism_jax.cli import envelope
from prism_jax.envelope.files import NAMES
from prism_jax.envelope.robot import of_robot
from prism_jax.io.depth import read_camera
from prism_jax.io.ply import read_ply
from tests import launching
from tests.experiments.simulation.roboarm.conftest import urdf
from tests.fake_completer import FakeCompleter

__all__ = ["urdf"]

FRAME = asset("roboarm") / "000-panda" / "000000"
SENSOR = "--sensor=camera 640x480, 70x55 degrees"
BOX = "--workspace=-1,-1,0,1,1,2"
SUFFIXES = ("partial.ply", "depth.png", "camera.json", "complete.ply", "joints.json")


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    monkeypatch.setattr(envelope, "load_completer", lambda weights: FakeCompleter())


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Nine cells, all alike."""
    root = tmp_path_factory.mktemp("recordings")
    for number in range(9):
        (root / f"{number:03d}-panda").mkdir()
        for suffix in SUFFIXES:
            source = FRAME.with_name(f"000000.{suffix}")
            shutil.copy(source, root / f"{number:03d}-panda" / source.name)
    return root


@pytest.fixture(scope="module")
def calibration(recordings, tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration") / "cal.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envelope, "load_completer", lambda weights: FakeCompleter())
        words = "calibrate", str(recordings), f"--output={path}"
        assert launching.run(envelope, *words) == 0
    return path


@pytest.fixture
def asked(calibration, tmp_path):
    terms = {"iso_13855": {"K": 1.6, "T": 0.5, "D_DS": 0.85, "Z": 0.1}}
    (tmp_path / "terms.json").write_text(json.dumps(terms))
    np.save(tmp_path / "query.npy", np.array([[0.0, 0, 5], [0.4, 0.0, 1.0]]))
    beside = {suffix: FRAME.with_name(f"000000.{suffix}") for suffix in SUFFIXES}
    return [
        str(beside["partial.ply"]),
        f"--depth={beside['depth.png']}",
        f"--camera={beside['camera.json']}",
        f"--calibration={calibration}",
        f"--ssm={tmp_path / 'terms.json'}",
        f"--query={tmp_path / 'query.npy'}",
        f"--output_dir={tmp_path / 'out'}",
        "--voxel=0.15",
    ]


def lines_in(folder):
    return [json.loads(line) for line in (folder / envelope.LINES).open()]


def names_in(folder):
    return {path.name for path in folder.iterdir()}


def arrays_of(folder):
    with np.load(folder / "envelope.npz", allow_pickle=False) as arrays:
        return dict(arrays)


def told_of(folder):
    return json.loads((folder / "envelope.json").read_text())


def test_all_files_are_written_and_agree(asked, calibration, tmp_path, capsys):
    content = json.loads(calibration.read_text())
    assert content["n"] == 9 and len(content["scores"]) == 9
    assert content["settings"]["robot"] == "unknown" and content["scaled"] is None
    assert content["q"] == content["scores"][0] > 0
    assert launching.run(envelope, *asked) == 0
    out = tmp_path / "out"
    assert names_in(out) == {*NAMES}
    told, arrays = told_of(out), arrays_of(out)
    assert "People are never predicted" in told["notice"]
    assert "Not safety-rated" in capsys.readouterr().out
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
    assert len(arrays["measured"]) > len(measured)
    assert arrays["query_surface"].shape == (2,)
    assert len(read_ply(out / "envelope.ply")) == (state != 4).sum()
    solid = trimesh.load(io.BytesIO((out / "envelope.stl").read_bytes()), "stl")
    assert solid.is_watertight and solid.volume > 0
    page = (out / "envelope.html").read_text()
    assert "Not safety-rated" in page and "S = K T + D_DS + Z = 1.75 m" in page
    ssm = told["separation"]["distances"]["iso_13855"]
    assert ssm["distance"] == pytest.approx(1.75)
    assert told["separation"]["inflation_of_objects"] == told["q"]
    assert told["query"]["nearest_not_known_to_be_free"] == 0


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--weights=another"], "weights"),
        (["--adapt"], "adapt False, not True"),
        (["--alpha=0.05"], "on 19 or more"),
        (["--scaled"], "omit --scaled"),
        (["--eye=0,0,0"], "omit it"),
        (["another.ply"], "expected one scan or recording, got 2"),
    ],
)
def test_what_does_not_match_is_one_line(asked, tmp_path, more, told, capsys):
    assert launching.run(envelope, *asked, *more) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert told in lines[-1] and lines[-1].startswith("prism-envelope: ")
    assert not list((tmp_path / "out").glob("*"))


def test_fewer_cells_than_can_tell_are_refused_at_once(tmp_path, capsys):
    words = "calibrate", str(asset("roboarm")), f"--output={tmp_path / 'cal.json'}"
    assert launching.run(envelope, *words) == 2
    assert "1 cells are too few" in capsys.readouterr().err
    assert not (tmp_path / "cal.json").exists()


def test_a_cloud_without_its_sensors_place_frees_nothing(stream, tmp_path, capsys):
    words = f"{stream[0]}/2.npy", *stream[1:-4], BOX
    assert launching.run(envelope, *words, SENSOR) == 0
    assert "no space is known to be free" in capsys.readouterr().err
    assert told_of(tmp_path / "out")["volumes"]["free"] == 0
    assert launching.run(envelope, *words) == 2
    assert "--sensor: missing" in capsys.readouterr().err


@pytest.fixture
def stream(asked, recordings, tmp_path):
    """Three frames of one recording, the second without a point in the workspace."""
    folder = tmp_path / "clouds"
    folder.mkdir()
    for number in range(3):
        points = read_ply(FRAME.with_name("000000.partial.ply")) + 50.0 * (number == 1)
        np.save(folder / f"{number}.npy", points)
    skipped = "--depth", "--camera"
    kept = [flag for flag in asked[1:] if not flag.startswith(skipped)]
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
    for name in ("volumes", "q", "query", "points"):
        assert first[name] == last[name] == told[name]
    arrays = (out / "envelope.npz").read_bytes()
    # A scan is taken in the same way.
    assert launching.run(envelope, f"{stream[0]}/2.npy", *stream[1:]) == 0
    assert (out / "envelope.npz").read_bytes() == arrays
    assert told_of(out)["volumes"] == told["volumes"]


def test_depth_images_of_a_recording_are_those_of_a_scan(asked, recordings, tmp_path):
    out = tmp_path / "out"
    kept = [flag for flag in asked[1:] if not flag.startswith(("--depth", "--camera"))]
    cell = str(recordings / "000-panda")
    assert launching.run(envelope, cell, "--topic=depth", *kept, BOX) == 0
    (line,) = lines_in(out)
    state = arrays_of(out)["state"]
    depth = asked[1].partition("=")[2]
    assert launching.run(envelope, depth, asked[2], *kept, BOX) == 0
    np.testing.assert_array_equal(arrays_of(out)["state"], state)
    assert line["volumes"] == told_of(out)["volumes"]


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


def test_a_known_robot_is_where_each_frame_says_and_needs_its_own_calibration(
    asked, stream, urdf, tmp_path, recordings, capsys
):
    known, texts = tmp_path / "recordings", []
    shutil.copytree(recordings, known)
    for number, path in enumerate(sorted(known.glob("*/*.joints.json"))):
        pose = {"yaw": 1.0 * number, "shoulder": 0.4, "elbow": 0.3}
        base = np.eye(4)
        base[:3, 3] = 0.5, 0.5, 1.0
        texts.append(json.dumps({"positions": pose, "base": base.tolist()}))
        path.write_text(texts[-1])
    own = f"--calibration={tmp_path / 'own.json'}"
    words = f"--urdf={urdf}", f"--output={tmp_path / 'own.json'}"
    assert launching.run(envelope, "calibrate", str(known), *words) == 0
    assert launching.run(envelope, "calibrate", str(recordings), *words) == 2
    assert "no position for joint 'yaw'" in capsys.readouterr().err
    (tmp_path / "joints.json").write_text(texts[1])
    joints = f"--joints={tmp_path / 'joints.json'}"
    assert launching.run(envelope, *asked, words[0], joints) == 2
    assert "calibrated for robot unknown, not known" in capsys.readouterr().err
    assert launching.run(envelope, *asked, words[0]) == 2
    assert "needs --joints" in capsys.readouterr().err
    for sequence in sorted(known.iterdir())[2:]:
        shutil.rmtree(sequence)
    kept = [f for f in stream[1:] if not f.startswith(("--cal", "--eye"))]
    words = *kept, own, words[0], "--topic=partial"
    assert launching.run(envelope, str(known), *words, "--every_frame") == 0
    out = tmp_path / "out"
    robots = []
    for number in ("000000", "000001"):
        arrays = arrays_of(out / number)
        robots.append(arrays["robot"])
        assert not of_robot(arrays["predicted"], arrays["robot"]).any()
    assert robots[0].shape == robots[1].shape and len(robots[0]) > 100
    assert np.abs(robots[0] - robots[1]).max() > 0.1
    told = told_of(out / "000001")
    assert told["points"]["robot"] > 100 and told["volumes"]["robot"] > 0
    # A file's are those of all frames.
    cell = str(known / "000-panda")
    assert launching.run(envelope, cell, *words, joints) == 0
    np.testing.assert_array_equal(arrays_of(out)["robot"], robots[1])
