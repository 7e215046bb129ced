"""Real scans of a folder are completed; what is not there is left out."""

import dataclasses
import importlib.util
import json

import numpy as np
import pytest
from PIL import Image

from experiments import real as command
from experiments import real_specs
from experiments.real_pictures import picture_row
from experiments.real_specs import SPECS
from prism_jax import metrics
from prism_jax.io import InputError, ply_bytes
from prism_jax.io.streams import Frame, Stream
from prism_jax.trust import Verdict
from tests import launching
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, size=(300, 3)).astype(np.float32)
CORNERS = [[0, 0, 0], [0, 1, 0], [2, 1, 0], [2, 0, 0]]
CORNERS = np.array([*CORNERS, *[[x, y, 4] for x, y, _ in CORNERS]], float)
BY_NAME = {spec.name: spec for spec in SPECS}


class Completer(FakeCompleter):
    """Judges what it completes if its weights are `small`, and trusts it more where
    nothing is around."""

    def __init__(self, name):
        self.judges = name == "small"

    @classmethod
    def from_pretrained(cls, name):
        return cls(name)

    def complete(self, *arguments, **asked):
        done = super().complete(*arguments, **asked)
        trust = {"unknown": "fair", "empty": "high"}[asked.get("background", "unknown")]
        verdict = Verdict(trust, 0.25, (), {}) if self.judges else None
        return dataclasses.replace(done, verdict=verdict)


def write_pcd(path, points, labels) -> str:
    """A labelled scan in ASCII."""
    rows = [
        f"{label} {x} {y} {z}" for label, (x, y, z) in zip(labels, points, strict=True)
    ]
    head = f"FIELDS label x y z\nSIZE 4 4 4 4\nTYPE U F F F\nWIDTH {len(rows)}\n"
    path.write_text(f"{head}HEIGHT 1\nDATA ascii\n" + "\n".join(rows) + "\n")
    return str(path)


def clutter():
    """Two things beside each other in x on a table at z = -1, as `FakeCompleter` tells
    them apart; one tenth of the first one lies with the second."""
    rng = np.random.default_rng(1)
    table = rng.uniform([0, 0, -1], [20, 9, -0.5], (700, 3))
    first = rng.uniform([1, 0, 0], [9, 9, 9], (600, 3))
    first[:60, 0] += 10
    second = rng.uniform([11, 0, 0], [19, 9, 9], (540, 3))
    labels = np.repeat([1, 30, 20], [700, 600, 540])
    return np.concatenate([table, first, second]), labels


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Real scans that are made up: no depth image, no sweep, and a capture that is
    none."""
    monkeypatch.setattr(command, "Completer", Completer)
    for name in ("bunny", "kinect", "kitti", "shapenet", "ouster"):
        (tmp_path / "real" / name).mkdir(parents=True)
    place = tmp_path / "real"
    pairs = {"scan_000": POINTS[:200], "scan_090": POINTS[100:], "complete": POINTS}
    np.savez(place / "bunny" / "pairs.npz", **pairs)
    clouds = ("bunny/raw_scan_000", "shapenet/airplane_partial_2048")
    for name in (*clouds, "shapenet/airplane_predicted_16384"):
        (place / f"{name}.ply").write_bytes(ply_bytes(POINTS))
    write_pcd(place / "kinect" / "mosd_test24.pcd", *clutter())
    write_pcd(place / "kitti" / "frame_0_car_0.pcd", POINTS, np.zeros(300, int))
    np.savetxt(place / "kitti" / "frame_0_car_0.txt", CORNERS)
    (place / BY_NAME["Ouster, capture"].file).write_bytes(b"anything")
    return place


def test_every_scan_has_a_row(folder, tmp_path, capsys):
    output, picture = tmp_path / "tables" / "real.json", tmp_path / "real.png"
    asked = [f"--data_dir={folder}", f"--output={output}", f"--picture={picture}"]
    weights = ["--weights=small", "--weights=other"]
    assert launching.run(command, *asked, *weights, "--size=32") == 0
    told = capsys.readouterr()
    result = json.loads(output.read_text())
    rows = {(row["scan"], row["weights"]): row for row in result["scans"]}
    assert len(rows) == len(result["scans"]) == 2 * 10

    row = rows["bunny, scan_000", "small"]
    assert (row["points"], row["added"], row["objects"]) == (200, 100, 1)
    assert (row["outside"], row["strays"], row["up"]) == (0, 1, "y")
    assert row["verdicts"] == [{"trust": "fair", "expected_error": 0.25}]
    assert rows["bunny, scan_000", "other"]["verdicts"] == []
    partial = row["scores"]["clouds"]["partial"]
    unit = np.ptp(POINTS, axis=0).max() / 2
    expected = metrics.cd_l2(POINTS[:200] / unit, POINTS / unit)
    assert partial["cd_l2"] == pytest.approx(expected, rel=1e-4)
    assert partial["prediction_to_truth"] == pytest.approx(0, abs=1e-12)
    assert rows["bunny, raw", "small"]["scores"] is None
    alone = rows["bunny, scan_000, alone", "small"]
    assert (row["background"], alone["background"]) == ("unknown", "empty")
    assert alone["verdicts"] == [{"trust": "high", "expected_error": 0.25}]

    scene = rows["Kinect, cloud", "small"]
    assert (scene["objects"], scene["strays"]) == (2, 2)
    # Ten per cent of the first are with the second: 540 of 600, and 540 of 600.
    assert scene["checks"]["overlap"] == {"thing 0": 0.9, "thing 1": 0.9}
    peer = rows["ShapeNet, airplane", "small"]["checks"]["to_peer"]
    assert peer["partial"] == pytest.approx(0, abs=1e-12) and peer["completed"] > 0

    assert set(result["left_out"]) == {
        "Kinect, depth image",
        "Ouster, sweep",
        "Ouster, capture",
    }
    (line,) = [s for s in told.err.splitlines() if s.startswith("Ouster, sweep is")]
    assert "no such file" in line
    with Image.open(picture) as sheet:
        # Neither the car nor the airplane is drawn.
        assert sheet.size == (2 * (3 * 32 + 4) - 4, 4 * (32 + 15))

    text = output.with_suffix(".md").read_text()
    assert text in told.out and text == command.real_markdown(result)
    cells = "| 200 | 1 | 100 | 0 | 1 | 1 fair | 0.25 |"
    assert f"| bunny, scan_000 | `small` {cells}" in text
    assert "| bunny, scan_000 | `other` | 200 | 1 | 100 | 0 | 1 | - | - |" in text
    head = f"| bunny, scan_000 | `small` | partial | {1e4 * partial['cd_l2']:.4g} |"
    assert head in text and "| thing 0: 0.9, thing 1: 0.9 |" in text
    assert "Left out: Ouster, sweep (" in text


@pytest.mark.skipif(
    importlib.util.find_spec("ouster") is not None, reason="ouster-sdk is installed"
)
def test_a_missing_package_leaves_its_recording_out(folder, capsys):
    assert launching.run(command, f"--data_dir={folder}", "--weights=small") == 0
    lines = capsys.readouterr().err.splitlines()
    (line,) = [line for line in lines if line.startswith("Ouster, capture is left out")]
    assert line.endswith('install the extra: pip install "prism_jax[ouster]"')


def test_a_missing_folder_ends_in_one_line(tmp_path, capsys):
    assert launching.run(command, f"--data_dir={tmp_path / 'none'}") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("real: --data_dir: ") and "bunny/pairs.npz, " in line


def test_a_folder_of_something_else_ends_in_one_line(tmp_path, capsys):
    assert launching.run(command, f"--data_dir={tmp_path}") == 2
    assert "has none of the scans" in capsys.readouterr().err.splitlines()[-1]


def test_a_picture_that_is_no_png_is_refused(tmp_path, capsys):
    assert launching.run(command, "--picture=real.jpg") == 2
    assert "--picture: real.jpg is no .png file" in capsys.readouterr().err


def test_points_outside_a_box_are_counted():
    """The box is 2 x 1 x 4, and a twentieth of a side may be beside it."""
    measured = np.array([[1, 0.5, 2], [-0.05, 0.5, 2], [2.05, 0.5, 2], [2.2, 0.5, 2]])
    added = np.array([[1, 1.04, 2], [1, 1.06, 2], [1, 0.5, -0.19], [1, 0.5, 4.3]])
    done = Completer("small").complete(POINTS)
    points, observed = np.concatenate([measured, added]), np.arange(8) < 4
    done = dataclasses.replace(done, points=points, observed=observed)
    assert real_specs.outside(CORNERS, done) == {"measured": 0.25, "added": 0.5}
    done = dataclasses.replace(done, points=measured, observed=observed[:4])
    assert real_specs.outside(CORNERS, done) == {"measured": 0.25}
    # A turned box and turned points.
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    done = dataclasses.replace(done, points=measured @ turn.T)
    assert real_specs.outside(CORNERS @ turn.T, done) == {"measured": 0.25}


def test_added_points_outside_the_workspace_are_counted():
    done = Completer("small").complete(POINTS.astype(float))
    assert command.num_outside(done) == 0
    beyond = np.where(done.observed[:, None], done.points, done.points + 10)
    far = dataclasses.replace(done, points=beyond)
    assert command.num_outside(far) == (~done.observed).sum() == 150


def test_a_lidar_reaches_so_far():
    points = np.array([[0, 0, 0], [5.9, 0, 0], [0, 6.1, 0], [4, 4, 4.0], [0, -1, 0]])
    np.testing.assert_array_equal(real_specs.near(points), points[[1, 4]])


@pytest.mark.parametrize(("lacking", "taken"), [("", 0), ("0", 1), ("01", 2), ("2", 0)])
def test_the_first_whole_frame_is_taken(monkeypatch, lacking, taken):
    class Sweeps(Stream):
        def __len__(self):
            return 3

        def _frames(self):
            for number in range(3):
                if str(number) in lacking:
                    self.remark("incomplete", "lacks columns")
                yield Frame(np.full((2, 3), number + 1, np.float32), number)

    monkeypatch.setattr(real_specs, "open_stream", Sweeps)
    given = real_specs.captured("some.pcap")
    assert (given.points == taken + 1).all()


def test_no_whole_frame(monkeypatch):
    class Nothing(Stream):
        def __len__(self):
            return 0

        def _frames(self):
            yield from ()

    monkeypatch.setattr(real_specs, "open_stream", Nothing)
    with pytest.raises(InputError, match="has no whole frame"):
        real_specs.captured("some.pcap")


def test_faults_of_files_are_told(tmp_path, folder):
    np.savez(tmp_path / "a.npz", scan_000=POINTS)
    with pytest.raises(InputError, match="is not an NPZ of scan_000 and complete"):
        real_specs.scanned_in_frame(tmp_path / "a.npz", "scan_000")
    (tmp_path / "b.npz").write_bytes(b"PK, but no more")
    with pytest.raises(InputError, match="is not an NPZ of scan_000 and complete"):
        real_specs.scanned_in_frame(tmp_path / "b.npz", "scan_000")
    path = folder / "kinect" / "mosd_test24.ply"
    path.write_bytes(ply_bytes(POINTS))
    with pytest.raises(InputError, match="has 300 points, and its labels 1,840"):
        real_specs.labelled(path)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("bunny, scan_090", 30_379),
        ("Kinect, depth image", 185_257),
        ("KITTI, car", 1_524),
        ("ShapeNet, airplane", 2_048),
        ("Ouster, sweep", 47_043),
    ],
)
def test_the_real_ones_are_read(real, name, count):
    spec = BY_NAME[name]
    given = spec.read(real(spec.file))
    assert len(given.points) == count
    assert given.points.dtype == np.float64 and np.isfinite(given.points).all()
    assert (given.truth is not None) == name.startswith("bunny")


def test_pictures_show_what_was_added_and_what_is_of_nothing():
    completer = Completer("small")
    points, _ = clutter()
    scene = completer.split_scene(points)
    done = completer.complete_scene(points, scene=scene)
    row = picture_row("clutter", {"small": done}, 64)
    assert row.label == "clutter"
    kinds = [kinds_of(picture) for picture in row.pictures]
    assert kinds == [{"blue", "grey", "white"}, {"blue", "grey", "orange", "white"}]
    # All that is of objects is within: nothing is drawn on the edge.
    alone = dataclasses.replace(done, object=np.where(done.object < 0, 0, done.object))
    for picture in picture_row("", {"small": alone}, 64).pictures:
        edge = [picture[0], picture[-1], picture[:, 0], picture[:, -1]]
        assert kinds_of(np.concatenate(edge)) == {"white"}


def kinds_of(pixels):
    """Which of the colours there are, in whatever shade."""
    red, _, blue = np.moveaxis(pixels.reshape(-1, 3).astype(int), -1, 0)
    grey, white = abs(red - blue) < 9, np.minimum(red, blue) > 250
    found = np.select([white, grey, red > blue], ["white", "grey", "orange"], "blue")
    return set(found.tolist())
