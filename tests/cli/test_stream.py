"""prism-stream, with a small network of any numbers."""

import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation.roboarm.sequences import make_frame, make_sequence
from prism_jax.cli import complete
from prism_jax.cli import stream as command
from prism_jax.completion.weights import save_weights
from prism_jax.data.recordings import LABELS
from prism_jax.envelope.robot import of_robot
from prism_jax.io.clouds import read_points
from prism_jax.io.depth import camera_to_dict
from prism_jax.io.ply import write_ply
from prism_jax.io.streams import open_stream
from tests.experiments.simulation.roboarm.conftest import model, small, urdf
from tests.launching import run

__all__ = ["model", "small", "urdf"]

ROOT = pathlib.Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def scans(tmp_path_factory, minimal, minimal_variables):
    """A folder of four clouds and one without a point in the workspace; weights beside
    it."""
    folder = tmp_path_factory.mktemp("stream")
    save_weights(folder / "w.safetensors", minimal.config, minimal_variables, {})
    rng = np.random.default_rng(0)
    (folder / "scans").mkdir()
    for number in range(5):
        points = rng.uniform([3, -1, -1], [4, 1, 1], (300, 3)).astype(np.float32)
        points += np.float32(100 * (number == 2))
        write_ply(folder / "scans" / f"{number}.ply", points)
    return folder


@pytest.fixture
def weights(scans, monkeypatch, tmp_path_factory):
    """Completers are compiled once for all tests."""
    monkeypatch.setenv("PRISM_JAX_CACHE", str(scans / "cache"))
    return f"--weights={scans / 'w.safetensors'}"


def test_a_folder_of_files(scans, weights, tmp_path, capsys):
    out = tmp_path / "out"
    box = "--workspace=0,-2,-2,9,2,2"
    assert run(command, str(scans / "scans"), weights, box, f"--output={out}") == 0
    printed = capsys.readouterr()
    assert "4 completed, 0 dropped, 1 unusable" in printed.out
    assert "skipped frame 2: the frame: no points inside" in printed.err
    names = sorted(path.name for path in out.iterdir())
    assert names == [*(f"00000{n}.ply" for n in (0, 1, 3, 4)), "stream.json"]
    summary = json.loads((out / "stream.json").read_text())
    assert summary["frames"] == {
        "in_recording": 5,
        "completed": 4,
        "dropped": 0,
        "unusable": 1,
    }
    assert summary["remarks"] == {"unusable": 1} and summary["whole"]
    assert set(summary["milliseconds"]["age"]) == {"p50", "p95", "p99", "max"}
    # As prism-complete has them.
    done = tmp_path / "done"
    complete.complete_file(
        str(scans / "scans" / "3.ply"),
        weights=weights.partition("=")[2],
        adapt=False,
        density=0.0,
        objects="one",
        output_dir=str(done),
    )
    one, other = done / "completed.ply", out / "000003.ply"
    assert one.read_bytes() == other.read_bytes()
    assert len(read_points(other)) > 300


def test_an_mcap_file(scans, weights, tmp_path):
    pytest.importorskip("mcap")
    out = tmp_path / "done.mcap"
    run(command, str(scans / "scans"), weights, f"--output={out}", "--pace=sensor")
    stream = open_stream(out)
    summary = json.loads((tmp_path / "stream.json").read_text())
    assert len(stream) == summary["frames"]["completed"]
    assert len(stream) + summary["frames"]["dropped"] == 5


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "expected one recording, got 0"),
        (["a", "b"], "expected one recording, got 2"),
        (["scan.txt"], "check the path"),
        (["SCANS", "--topic=/points"], "omit --topic"),
        (["SCANS", "--workspace=1,2"], "--workspace: cannot read"),
        (["SCANS", "--up=q"], "cannot read 'q'"),
        (["SCANS", "--camera=no.json"], "no such file"),
        (["SCANS", "--adapt=always"], "--help lists the flags"),
        (["SCANS", "--joints=j.json"], "set --urdf too"),
        (["SCANS", "--output=SCANS"], "choose another output"),
    ],
)
def test_faults_are_one_line(scans, arguments, fault, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = [word.replace("SCANS", str(scans / "scans")) for word in arguments]
    assert run(command, *given) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("prism-stream: ") and fault in line
    assert not list(tmp_path.iterdir())


def test_weights_that_are_none_leave_no_file(scans, capsys, tmp_path):
    out = f"--output={tmp_path / 'out.mcap'}"
    assert run(command, str(scans / "scans"), out, "--weights=nobody") == 2
    assert "nobody" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGKILL])
def test_a_stream_that_is_ended_leaves_whole_files(ending, scans, weights, tmp_path):
    """In the middle of forty seconds of recording."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for path in (scans / "scans").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    for number in range(10, 400):
        os.link(folder / "0.ply", folder / f"{number}.ply")
    out = tmp_path / "out"
    program = [sys.executable, "-m", "prism_jax.cli.stream", str(folder)]
    started = subprocess.Popen(
        [*program, weights, f"--output={out}", "--pace=sensor"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and len(list(out.glob("*.ply"))) < 4:
        time.sleep(0.05)
    started.send_signal(ending)
    _, told = started.communicate(timeout=60)
    done = sorted(out.glob("*.ply"))
    assert len(done) >= 4
    for path in done:
        assert len(read_points(path)) > 300
    if ending == signal.SIGKILL:
        assert started.returncode == -signal.SIGKILL
        return
    assert started.returncode == 130
    assert told.splitlines()[-1] == "prism-stream: interrupted"
    summary = json.loads((out / "stream.json").read_text())
    assert not summary["whole"]
    assert summary["frames"]["completed"] == len(done)


def test_a_known_robot_from_end_to_end(
    weights, model, urdf, small, tmp_path, monkeypatch, capsys
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
    known = weights, box, f"--urdf={urdf}"
    first = f"--base={beside}/000/000000.joints.json"
    assert (
        run(command, "cell.mcap", "--camera=c.json", *known, first, "--output=a") == 0
    )
    assert run(command, str(beside), "--topic=depth", *known, "--output=b") == 0
    for number, frame in enumerate(frames):
        clouds, labels = [], []
        for folder in "ab":
            read = plyfile.PlyData.read(f"{folder}/{number:06d}.ply")["vertex"]
            clouds.append(np.stack([read[axis] for axis in "xyz"], axis=1))
            labels.append(read["label"])
        known_points = [c[i == 2] for c, i in zip(clouds, labels, strict=True)]
        np.testing.assert_allclose(*known_points, atol=1e-6)
        away = KDTree(known_points[0]).query(frame.complete)[0]
        # What the depth image has of the robot is gone, its surface is there.
        robots = frame.labels[frame.depth > 0] == LABELS["robot"]
        assert robots.sum() > 100 and (away < 0.03).mean() > 0.3
        for cloud, label in zip(clouds, labels, strict=True):
            assert not of_robot(cloud[label < 2], known_points[0], 0.0299).any()
    capsys.readouterr()
    only = weights, f"--urdf={urdf}", "--output=c"
    assert run(command, "cell.mcap", *only, "--joints=/arm") == 2
    assert "set --joints to one of /joint_states" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    assert run(command, "cell.mcap", *only) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert 'pip install "prism_jax[robots]"' in line
