"""prism-stream, with a small network of any numbers."""

import dataclasses
import json
import pathlib
import signal
import sys

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation.roboarm.sequences import make_frame, make_sequence
from prism_jax.cli import complete
from prism_jax.cli import stream as command
from prism_jax.cli.launch import load_completer
from prism_jax.completion.weights import save_weights
from prism_jax.data.recordings import LABELS
from prism_jax.envelope.robot import of_robot
from prism_jax.io.clouds import read_points
from prism_jax.io.depth import camera_to_dict
from prism_jax.io.ply import ply_bytes, read_ply
from prism_jax.streaming.completer import FrameCompleter
from tests.experiments.simulation.roboarm.conftest import model, small, urdf
from tests.launching import run

__all__ = ["model", "small", "urdf"]


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """A folder of four clouds and one without a point in the workspace."""
    folder = tmp_path_factory.mktemp("stream")
    rng = np.random.default_rng(0)
    for number in range(5):
        points = rng.uniform([3, -1, -1], [4, 1, 1], (300, 3)).astype(np.float32)
        points += np.float32(100 * (number == 2))
        fields = {"intensity": points[:, 1].astype(np.float64), "label": np.arange(300)}
        (folder / f"{number}.ply").write_bytes(ply_bytes(points, fields=fields))
    return folder


@pytest.fixture
def shared(completer, monkeypatch):
    """Whatever the weights are called, they are those of all tests."""
    for program in (command, complete):
        monkeypatch.setattr(program, "load_completer", lambda *about: completer)


def test_weights_of_a_file_are_compiled_once(
    scans, minimal, minimal_variables, tmp_path, monkeypatch, capsys
):
    """And kept for the next process."""
    monkeypatch.setenv("PRISM_JAX_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "w.safetensors"
    save_weights(path, minimal.config, minimal_variables, {})
    words = f"--weights={path}", f"--output={tmp_path / 'out'}"
    assert run(command, str(scans), *words) == 0
    said = capsys.readouterr().out
    assert "5 completed, 0 dropped, 0 unusable" in said
    assert "each whole frame as one object; --workspace" in said
    assert said.endswith("open the PLY files in CloudCompare or MeshLab\n")
    assert len(list((tmp_path / "cache").rglob("*.jaxcompiled"))) == 1
    assert load_completer(str(path)) is load_completer(str(path))


def test_a_folder_of_files(scans, shared, tmp_path, capsys):
    out, done = tmp_path / "out", tmp_path / "done"
    box = "--workspace=0,-2,-2,9,2,2"
    assert run(command, str(scans), box, f"--output={out}") == 0
    printed = capsys.readouterr()
    assert "4 completed, 0 dropped, 1 unusable" in printed.out
    assert "skipped frame 2: the frame: no points inside" in printed.err
    names = sorted(path.name for path in out.iterdir())
    assert names == [*(f"00000{n}.ply" for n in (0, 1, 3, 4)), "stream.json"]
    summary = json.loads((out / "stream.json").read_text())
    counts = {"in_recording": 5, "completed": 4, "dropped": 0, "unusable": 1}
    assert summary["frames"] == counts
    assert summary["remarks"] == {"unusable": 1} and summary["whole"]
    assert summary["timestamps"] == {str(n): n * 10**8 for n in (0, 1, 3, 4)}
    # As prism-complete has them.
    asked = {"density": 0.0, "objects": "one", "output_dir": str(done)}
    complete.complete_file(str(scans / "3.ply"), **asked)
    one, other = done / "completed.ply", out / "000003.ply"
    assert one.read_bytes() == other.read_bytes()
    read_ply(other, fields=(fields := {}))
    np.testing.assert_array_equal(fields["input_label"][:300], np.arange(300))
    assert len(read_points(other)) > 300


def test_without_a_completed_frame_it_fails_and_an_older_file_stays(
    scans, shared, tmp_path, capsys
):
    pytest.importorskip("mcap")
    out = tmp_path / "out.mcap"
    out.write_bytes(b"older")
    words = "--workspace=50,-2,-2,59,2,2", f"--output={out}"
    assert run(command, str(scans), *words) == 2
    said = capsys.readouterr()
    told = "no frame was completed; skipped frame 0: the frame: no points inside"
    assert told in said.err.splitlines()[-1] and "written" not in said.out
    assert out.read_bytes() == b"older"
    summary = json.loads((tmp_path / "stream.json").read_text())
    assert summary["whole"] and summary["frames"]["completed"] == 0
    assert {path.name for path in tmp_path.iterdir()} == {"out.mcap", "stream.json"}


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "expected one recording, got 0"),
        (["SCANS", "--joints=j.json"], "set --urdf too"),
        (["SCANS", "--camera=/camera_info"], "no CameraInfo in this recording"),
        (["SCANS", "--output=SCANS"], "choose another output"),
        (["SCANS", "--output=out.mcap", "--weights=nobody"], "nobody"),
    ],
)
def test_faults_are_one_line(scans, arguments, fault, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = [word.replace("SCANS", str(scans)) for word in arguments]
    assert run(command, *given) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("prism-stream: ") and fault in line
    assert not list(tmp_path.iterdir())


def test_a_stream_that_is_ended_leaves_whole_files(
    scans, shared, tmp_path, monkeypatch, capsys
):
    plain = FrameCompleter.complete

    def ended(self, frame):
        if frame.timestamp == 3 * 10**8:
            signal.raise_signal(signal.SIGTERM)
        return plain(self, frame)

    monkeypatch.setattr(FrameCompleter, "complete", ended)
    assert run(command, str(scans), f"--output={tmp_path}") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "prism-stream: interrupted"
    done = [read_points(path) for path in tmp_path.glob("*.ply")]
    assert len(done) == 3 and min(map(len, done)) > 300
    summary = json.loads((tmp_path / "stream.json").read_text())
    assert not summary["whole"] and summary["frames"]["completed"] == 3


def test_a_known_robot_from_end_to_end(
    shared, model, urdf, small, tmp_path, monkeypatch, capsys
):
    """By joint states of an MCAP, and by the files beside the same frames."""
    recording = pytest.importorskip("experiments.simulation.roboarm.recording")
    pytest.importorskip("mcap")
    plyfile = pytest.importorskip("plyfile")
    rng = np.random.default_rng(0)
    small = dataclasses.replace(small, width=160, height=120)
    sequence = make_sequence(model, 2, small, rng)
    frames = [make_frame(sequence, number, small, rng) for number in range(2)]
    base = sequence.robot.mount.copy()
    base[2, 3] += sequence.cell.base_height
    told = {"base": base.tolist()}
    frames = [dataclasses.replace(f, joints={**f.joints, **told}) for f in frames]
    monkeypatch.chdir(tmp_path)
    beside = recording.record("cell.mcap", frames)
    pathlib.Path("c.json").write_text(json.dumps(camera_to_dict(sequence.cell.camera)))
    bounds = [*sequence.cell.lower, *sequence.cell.upper]
    box = f"--workspace={','.join(map(str, bounds))}"
    known = box, f"--urdf={urdf}"
    first = f"--base={beside}/000/000000.joints.json"
    of_file = "cell.mcap", "--camera=c.json", first
    assert run(command, *of_file, *known, "--output=a") == 0
    assert run(command, str(beside), "--topic=depth", *known, "--output=b") == 0
    told = json.loads(pathlib.Path("a/stream.json").read_text())
    assert told["joints_skew"] == {"seconds": 0, "metres": 0}
    assert (told["frame_id"], told["robot_speed"]) == (None, 0.25)
    for number, frame in enumerate(frames):
        surfaces = []
        for folder in "ab":
            read = plyfile.PlyData.read(f"{folder}/{number:06d}.ply")["vertex"]
            cloud = np.stack([read[axis] for axis in "xyz"], axis=1)
            surfaces.append(cloud[read["label"] == 2])
            rest = cloud[read["label"] < 2]
            assert not of_robot(rest, surfaces[-1], 0.0299).any()
        np.testing.assert_allclose(*surfaces, atol=1e-6)
        # What the depth image has of the robot is gone, its surface is there.
        robots = frame.labels[frame.depth > 0] == LABELS["robot"]
        away = KDTree(surfaces[0]).query(frame.complete)[0]
        assert robots.sum() > 100 and (away < 0.03).mean() > 0.3
    capsys.readouterr()
    only = f"--urdf={urdf}", "--output=c"
    assert run(command, "cell.mcap", *only, "--joints=/arm") == 2
    assert "set --joints to one of /joint_states" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    assert run(command, "cell.mcap", *only) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert 'pip install "prism_jax[robots]"' in line
