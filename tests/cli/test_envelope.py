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
from prism_jax.io.ply import read_ply
from tests import launching
from tests.fake_completer import FakeCompleter
from tests.simulation.roboarm.conftest import urdf

__all__ = ["urdf"]

FRAME = asset("roboarm") / "000-panda" / "000000"
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
        "--voxel=0.1",
    ]


def test_a_calibration_holds_what_it_is_for(calibration):
    content = json.loads(calibration.read_text())
    assert content["n"] == 9 and len(content["scores"]) == 9
    assert content["sensor"] == "camera 640x480, 70x55 degrees"
    assert content["settings"]["robot"] == "unknown"
    assert content["scaled"] is None
    assert content["q"] == content["scores"][0] > 0


def test_all_files_are_written_and_agree(asked, tmp_path, capsys):
    assert launching.run(envelope, *asked) == 0
    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)
    told = json.loads((out / "envelope.json").read_text())
    assert "People are never predicted" in told["notice"]
    assert "Not safety-rated" in capsys.readouterr().out
    with np.load(out / "envelope.npz", allow_pickle=False) as arrays:
        state, voxel = arrays["state"], float(arrays["voxel"])
        assert state.shape == tuple(told["grid"]["shape"])
        for number, name in enumerate(arrays["states"]):
            volume = (state == number).sum() * voxel**3
            assert told["volumes"][str(name)] == pytest.approx(volume)
        assert told["volumes"]["free"] > 0 and told["volumes"]["unseen"] > 0
        assert (arrays["not_free"][state != 4] == 0).all()
        assert (arrays["not_free"][state == 4] > 0).all()
        measured = read_ply(FRAME.with_name("000000.partial.ply"))
        count = len(measured)
        np.testing.assert_array_equal(arrays["measured"][:count], measured)
        assert len(arrays["measured"]) > count
        assert arrays["query_surface"].shape == (2,)
        envelope_volume = arrays["envelope"].sum() * voxel**3
    assert told["volumes"]["envelope"] == pytest.approx(envelope_volume)
    assert len(read_ply(out / "envelope.ply")) == (state != 4).sum()
    solid = trimesh.load(io.BytesIO((out / "envelope.stl").read_bytes()), "stl")
    assert solid.is_watertight and solid.volume > 0
    page = (out / "envelope.html").read_text()
    assert "Not safety-rated" in page and "S = K T + D_DS + Z = 1.75 m" in page
    ssm = told["separation"]["distances"]["iso_13855"]
    assert ssm["distance"] == pytest.approx(1.75)
    assert told["separation"]["inflation_of_objects"] == told["q"]
    assert told["query"]["nearest_not_known_to_be_free"] == 0


def test_the_same_scan_gives_the_same_arrays_and_surface(asked, tmp_path):
    launching.run(envelope, *asked)
    names = ("envelope.npz", "envelope.ply", "envelope.stl")
    first = [(tmp_path / "out" / name).read_bytes() for name in names]
    launching.run(envelope, *asked)
    assert first == [(tmp_path / "out" / name).read_bytes() for name in names]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--weights=small"], "weights"),
        (["--density=2"], "density 1.0, not 2.0"),
        (["--sensor=another"], "sensor"),
        (["--adapt"], "adapt False, not True"),
        (["--alpha=0.05"], "on 19 or more"),
        (["--alpha=0"], "alpha: cannot be 0"),
        (["--scaled"], "leave out --scaled"),
        (["--calibration="], "calibration"),
        (["--ssm=nothing.json"], "no such file"),
        (["--eye=0,0,0"], "leave it out"),
        (["--voxel=0"], "voxel"),
        (["--workspace=0,0,0,1,1"], "six"),
        (["another.ply"], "got 2 scans"),
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
    assert "holds 1 cells" in capsys.readouterr().err
    assert not (tmp_path / "cal.json").exists()


def test_a_cloud_without_its_sensors_place_frees_nothing(asked, tmp_path, capsys):
    cloud = asked[0]
    flags = [flag for flag in asked[3:] if not flag.startswith("--ssm")]
    sensor = "--sensor=camera 640x480, 70x55 degrees"
    assert launching.run(envelope, cloud, *flags, sensor) == 0
    assert "nothing is free" in capsys.readouterr().err
    told = json.loads((tmp_path / "out" / "envelope.json").read_text())
    assert told["volumes"]["free"] == 0
    assert launching.run(envelope, cloud, *flags, sensor, "--eye=2,0,1.5") == 0
    told = json.loads((tmp_path / "out" / "envelope.json").read_text())
    assert told["volumes"]["free"] > 0
    assert launching.run(envelope, cloud, *flags) == 2
    assert "--sensor: is missing" in capsys.readouterr().err


def test_a_known_robot_is_put_back_and_needs_its_own_calibration(
    asked, calibration, recordings, urdf, tmp_path, capsys
):
    base = np.eye(4)
    base[:3, 3] = 0.5, 0.5, 1.0
    joints = {"positions": {"yaw": 0.2, "shoulder": 0.4, "elbow": 0.3}}
    text = json.dumps(joints | {"base": base.tolist()})
    known = tmp_path / "recordings"
    shutil.copytree(recordings, known)
    for path in known.glob("*/*.joints.json"):
        path.write_text(text)
    own = tmp_path / "own.json"
    words = f"--urdf={urdf}", f"--output={own}"
    assert launching.run(envelope, "calibrate", str(known), *words) == 0
    (tmp_path / "joints.json").write_text(text)
    robot = words[0], f"--joints={tmp_path / 'joints.json'}"
    assert launching.run(envelope, *asked, *robot) == 2
    told = f"{calibration}: is for robot unknown, not known"
    assert told in capsys.readouterr().err
    assert launching.run(envelope, *asked, words[0]) == 2
    assert "without --joints" in capsys.readouterr().err
    assert launching.run(envelope, *asked, *robot, f"--calibration={own}") == 0
    out = json.loads((tmp_path / "out" / "envelope.json").read_text())
    assert out["points"]["robot"] > 100 and out["volumes"]["robot"] > 0
    words = "calibrate", str(recordings), f"--urdf={urdf}"
    assert launching.run(envelope, *words, f"--output={tmp_path / 'no.json'}") == 2
    assert "has no position of the joint 'yaw'" in capsys.readouterr().err
