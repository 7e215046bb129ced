import dataclasses
import hashlib
import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.assets import CELLS
from experiments.simulation.recorder import has_frame, write_frame
from prism_jax.data.manifest import MANIFEST, hash_files
from prism_jax.data.recordings import DEPTH_SCALE, LABELS, RecordedCells, RecordedFrame
from prism_jax.data.source import Source
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import NEARER, SURFACE, UNKNOWN, look_up
from prism_jax.io.errors import InputError
from tests.io.test_depth import packed as png

HEIGHT, WIDTH, FOCAL = 24, 32, 30.0
WALL = np.full((HEIGHT, WIDTH), 6000, np.uint16)


def camera():
    """One metre up, one and a half before the origin, looking along +x."""
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    intrinsics = np.array([[FOCAL, 0, 15.5], [0, FOCAL, 11.5], [0, 0, 1.0]])
    position = np.array([-1.5, 0.0, 1.0])
    return Camera(rotation, -rotation @ position, intrinsics, HEIGHT, WIDTH)


def frame(complete=True):
    """A wall in the plane x = 0, less a column without returns."""
    rng = np.random.default_rng(0)
    depth = WALL.copy()
    depth[:, 3] = 0
    rows, columns = np.nonzero(depth)
    y, z = -(columns - 15.5) / FOCAL * 1.5, 1.0 - (rows - 11.5) / FOCAL * 1.5
    partial = np.stack([0 * y, y, z], axis=1).astype(np.float32)
    labels = np.where(depth > 0, LABELS["robot"], LABELS["nothing"]).astype(np.uint8)
    return RecordedFrame(
        depth=depth,
        camera=camera(),
        partial=partial,
        complete=rng.normal(size=(100, 3)).astype(np.float32) if complete else None,
        labels=labels if complete else None,
        joints={"robot": "none", "positions": {"a": 0.25}} if complete else None,
    )


@pytest.fixture
def root(tmp_path):
    """Two sequences: a whole frame and a bare one; a bare one; and hidden files."""
    write_frame(tmp_path / "one", 0, frame())
    bare = frame(complete=False)
    write_frame(tmp_path / "one", 12, bare)
    moved = dataclasses.replace(bare, partial=bare.partial[5:])
    write_frame(tmp_path / "two", 3, moved)
    (tmp_path / "one" / ".000001.depth.png.123.tmp").write_bytes(b"half")
    (tmp_path / ".cache").mkdir()
    (tmp_path / "README.txt").write_text("recorded on Monday")
    return tmp_path


@pytest.mark.parametrize("complete", [True, False])
def test_a_frame_comes_back_bit_for_bit(tmp_path, complete):
    """Written again, it leaves nothing of the old one."""
    written = frame(complete)
    folder = tmp_path / "one"
    write_frame(folder, 7, frame())
    write_frame(folder, 7, written)
    assert has_frame(folder, 7) and not has_frame(folder, 8)
    read = RecordedCells(tmp_path).read(0)
    for name in ("depth", "partial", "complete", "labels"):
        first, second = getattr(written, name), getattr(read, name)
        if first is None:
            assert second is None
        else:
            assert second.dtype == first.dtype
            np.testing.assert_array_equal(second, first)
    assert read.joints == written.joints
    for name in ("rotation", "translation", "intrinsics"):
        expected = getattr(written.camera, name)
        np.testing.assert_array_equal(getattr(read.camera, name), expected)


def test_recordings_are_a_source_of_examples(root):
    cells = RecordedCells(root)
    assert isinstance(cells, Source)
    names = ["one/000000", "one/000012", "two/000003"]
    assert [example.name for example in cells] == names
    assert cells.objects.tolist() == [0, 0, 1]
    first, second, third = cells
    written = frame()
    np.testing.assert_array_equal(first.partial, written.partial)
    np.testing.assert_array_equal(third.partial, written.partial[5:])
    np.testing.assert_array_equal(first.complete, written.complete)
    np.testing.assert_allclose(first.eye, (-1.5, 0, 1), atol=1e-6)
    assert second.complete is None
    assert {first.category, second.category} == set(cells.categories)
    stored = json.loads((root / "one" / "000000.camera.json").read_text())
    assert stored["depth_scale"] == DEPTH_SCALE == 0.25e-3


def test_what_the_camera_knows_is_told_by_its_whole_image_and_no_labels(tmp_path):
    """A post before the wall and a hole in it; of the wall a patch is the object."""
    whole = frame()
    depth = whole.depth.copy()
    depth[:, 20:22], depth[8:11, 8:11] = 2000, 40000
    patch = (np.abs(whole.partial[:, 1]) < 0.2) & (
        np.abs(whole.partial[:, 2] - 1) < 0.3
    )
    image = dataclasses.replace(whole, depth=depth, partial=whole.partial[patch])
    write_frame(tmp_path / "one", 0, image)
    bare = dataclasses.replace(image, complete=None, labels=None, joints=None)
    write_frame(tmp_path / "two", 0, bare)
    (first, second) = RecordedCells(tmp_path)
    known = first.visibility
    for one, other in zip(known[1:], second.visibility[1:], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(known.camera.position, first.eye, atol=1e-6)
    points = [
        (0.1, 0.1, 1.0),  # behind the patch
        (-0.5, -0.167, 1.0),  # behind the post, which is at x = -1
        (0.5, 0.3, 1.0),  # behind the wall beside the patch
        (0.1, -1.4, 1.0),  # beside the map
    ]
    states, behind = look_up(known, np.array(points))
    np.testing.assert_array_equal(states, [SURFACE, NEARER, NEARER, UNKNOWN])
    np.testing.assert_allclose(behind[:3], [0.1, 0.5, 0.5], atol=0.05)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("000000.camera.json", "000000.camera.json: file missing .* again"),
        ("000000.partial.ply", "000000.partial.ply: file missing .* again"),
        ("12.depth.png", "12.depth.png: name is not six digits"),
        ("000000.colour.png", "000000.colour.png: not one of"),
    ],
)
def test_files_that_lack_or_are_out_of_the_layout_are_refused(root, name, message):
    path = root / "one" / name
    if path.exists():
        path.unlink()
    else:
        path.write_bytes(b"a")
    with pytest.raises(InputError, match=message):
        RecordedCells(root)


@pytest.mark.parametrize(
    ("suffix", "spoilt", "message"),
    [
        ("depth.png", png(WALL[1:]), "depth.png.*32x23.*32x24"),
        ("depth.png", png(WALL.astype(np.uint8)), "depth.png.*16-bit"),
        ("depth.png", png(WALL * 0), "no valid depth pixels"),
        ("depth.png", png(WALL)[:60], "depth.png: not a valid .*image"),
        ("camera.json", {"depth_scale": 0.001}, "camera.json: depth_scale is"),
        ("camera.json", {"fx": -1}, "camera.json.*positive"),
        ("camera.json", {"translation": [0, 0, 0]}, "0 of 744 points match the depth"),
        ("labels.png", png(WALL), "labels.png: .*I;16"),
        ("labels.png", png(np.uint8(0 * WALL + 9)), "labels.png: invalid label 9"),
        ("labels.png", b"PNG", "not a PNG"),
        ("joints.json", b"[1]", "not JSON: a list, not an"),
        ("complete.ply", b"x", "complete.ply"),
    ],
    ids=range(12),
)
def test_files_that_do_not_fit_are_named(tmp_path, suffix, spoilt, message):
    write_frame(tmp_path / "one", 0, frame())
    path = tmp_path / "one" / f"000000.{suffix}"
    if isinstance(spoilt, dict):
        spoilt = json.dumps(json.loads(path.read_text()) | spoilt).encode()
    path.write_bytes(spoilt)
    with pytest.raises(InputError, match=message):
        RecordedCells(tmp_path).read(0)


def test_files_are_held_against_the_manifest(root):
    files = hash_files(root)
    name = "one/000012.depth.png"
    assert files[name] == hashlib.sha256((root / name).read_bytes()).hexdigest()
    (root / MANIFEST).write_text(json.dumps({"files": files}))
    assert len(RecordedCells(root)) == 3
    (root / name).write_bytes(png(WALL))
    with pytest.raises(InputError, match=f"{name}: differs from the manifest"):
        RecordedCells(root)


def test_the_recorded_cells_are_one_scene_each_in_one_frame():
    """What the camera saw lies on the ground truth, to both sensors' noise."""
    cells = RecordedCells(CELLS)
    assert len(cells) == 12
    for number in (0, 7):
        example, frame = cells[number], cells.read(number)
        assert example.complete.shape == (16384, 3)
        assert (frame.camera.width, frame.camera.height) == (640, 480)
        seen = np.isin(frame.labels, (LABELS["robot"], LABELS["fixture"]))
        assert 0.6 < len(example.partial) / np.count_nonzero(seen) <= 1
        distance, _ = cKDTree(example.complete).query(example.partial)
        assert np.median(distance) < 0.006
        assert np.mean(distance < 0.02) > 0.95
        assert example.complete[:, 2].min() > 0
