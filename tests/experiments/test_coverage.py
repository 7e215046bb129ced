"""What is said of margins, from cells that are made up."""

import json

import numpy as np
import pytest
from scipy.stats import binomtest

from experiments import coverage
from experiments.coverage import PARTS, SAMPLE, Scored
from prism_jax.data.recordings import DEPTH_SCALE
from prism_jax.geometry.camera import Camera
from tests import launching
from tests.fake_completer import FakeCompleter


def scored(score, tested=True, size: float = 1.0):
    """Every other voxel is free; voxels are up to 2 m away."""
    free = np.arange(SAMPLE) % 2 == 0
    away = dict.fromkeys(coverage.AROUND, np.linspace(0, 2, SAMPLE)) if tested else {}
    return Scored(dict.fromkeys(coverage.AROUND, score), size, away, ~free, free)


def test_rows_hold_margins_coverage_and_volumes():
    """20 cells of even scores, and 20 others of which half need more."""
    found = {
        "calibration": [scored(s, tested=False) for s in np.linspace(0.1, 0.29, 20)],
        "other_arms": [scored(0.029, tested=False)] * 20,
        "test": [scored(0.1)] * 10 + [scored(0.58)] * 10,
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coverage, "GROUPS", 1)
        told = coverage.coverage(found)
    rows = {(r["calibrated_on"], r["rule"]): r for r in told["rows"][::-1]}
    own, other = rows["calibration", "fixed"], rows["other_arms", "fixed"]
    # The 19th of 20 scores.
    assert own["q"] == pytest.approx(0.28)
    assert (own["covered"], own["tested"], other["covered"]) == (10, 20, 0)
    wanted = binomtest(10, 20).proportion_ci(method="exact")
    np.testing.assert_allclose(own["interval"], [wanted.low, wanted.high])
    # Half of what is nearer than q and half a voxel's diagonal, of 27 cubic metres.
    reached = (0.28 + 0.5 * np.sqrt(3) * 0.04) / 2
    assert own["volume"] == pytest.approx(27 * reached / 2, rel=0.01)
    assert told["free_volume"] == pytest.approx(13.5)
    assert told["occupied_voxels_freed"] == told["occupied_voxels"] / 2
    # Two missed cells take alpha from 0.1 to 0.01, which no margin is for. After eight
    # more it is 0.05, by which the next is missed.
    assert rows["calibration", "by_size"]["q"] == own["q"]
    last = rows["other_arms", "updated"]
    assert (last["infinite"], last["covered"]) == (17, 17)


def test_scans_of_each_size_have_a_margin_of_their_own():
    small = [scored(s, False, 1 + s) for s in np.linspace(0.1, 0.19, 10)]
    middle = [scored(s, False, 5 + s) for s in np.linspace(0.3, 0.39, 10)]
    large = [scored(s, False, 9 + s) for s in np.linspace(0.5, 0.59, 10)]
    asked = [scored(0, size=s) for s in (0.5, 5.2, 20.0)]
    found = coverage.by_size(small + middle + large, asked, "measured")
    np.testing.assert_allclose(found, [0.19, 0.39, 0.59])


def ball(radius, middle, count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return middle + radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def write_cell(path, radius):
    """A ball above a floor, and a robot that is a small ball beside it."""
    camera = Camera.look_at(np.array([1.4, 0, 1.6]), np.array([0, 0, 0.5]), height=96)
    fixture, robot = ball(radius, [0, 0, 0.6], 40_000), ball(0.1, [0, 0.6, 0.5], 4_000)
    floor = np.random.default_rng(1).uniform(-1.4, 1.4, (100_000, 3)) * [1, 1, 0]
    points = np.concatenate([fixture, robot, floor])
    pixel, depth = (np.asarray(found) for found in camera.pixel_of(points))
    image = np.full(camera.height * camera.width + 1, np.inf)
    np.minimum.at(image, pixel, depth)
    seen = (depth <= image[pixel] + 0.02) & (np.arange(len(points)) < 44_000)
    image = np.where(np.isfinite(image), image, 0)[:-1].reshape(camera.height, -1)
    parts = dict.fromkeys(PARTS, floor[:1000]) | {"fixture": fixture, "robot": robot}
    path.parent.mkdir(exist_ok=True)
    np.savez(
        path,
        **{name: getattr(camera, name) for name in coverage._CAMERA},
        counts=np.round(image / DEPTH_SCALE).astype(np.uint16),
        partial=points[seen][::5].astype("f4"),
        complete=points[:44_000:20].astype("f4"),
        **{f"part_{name}": some.astype("f4") for name, some in parts.items()},
    )


def test_the_command_calibrates_and_tests(tmp_path, monkeypatch, capsys):
    """The stand-in completes by a mirror image, which is near the hidden side."""
    assert launching.run(coverage, "--num_cells=26") == 2
    assert "use 27 or more" in capsys.readouterr().err
    monkeypatch.setattr(coverage, "SAMPLE", 1000)
    monkeypatch.setattr(coverage, "ALPHA", 0.25)
    monkeypatch.setattr(coverage, "GROUPS", 1)
    monkeypatch.setattr(
        coverage.Completer, "from_pretrained", lambda *place: FakeCompleter()
    )
    for number in range(3):
        write_cell(tmp_path / "test-1" / f"{number:04d}.npz", 0.2 + 0.06 * number)
    for folder in ("test-2", "validation-1"):
        (tmp_path / folder).symlink_to(tmp_path / "test-1")
    output = tmp_path / "coverage.json"
    given = "--num_cells=3", "--num_tested=2", f"--cell_dir={tmp_path}"
    assert launching.run(coverage, *given, f"--output={output}") == 0
    assert "| known | cloud | measured and predicted | fixed | " in (
        capsys.readouterr().out
    )
    found = json.loads(output.read_text())["robot"]
    for robot in ("unknown", "known"):
        depth, cloud = found[robot]["both"], found[robot]["cloud"]
        assert 0.1 < depth["free_volume"] < 26
        assert 0 <= cloud["free_volume"] < depth["free_volume"]
        assert depth["occupied_voxels_freed"] < 0.01 * depth["occupied_voxels"]
        for told in (depth, cloud):
            rows = [row for row in told["rows"] if row["rule"] == "fixed"]
            measured, completed = rows[:2]
            assert 0 < completed["q"] < measured["q"] < 0.8
            # The largest of three scores holds cells that are among the three.
            assert measured["covered"] == measured["tested"] == 2
            assert measured["q"] == max(told["scores"]["calibration"]["measured"])
