import dataclasses
import hashlib
import io
import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from experiments.assets import CELLS
from experiments.simulation.recorder import has_frame, write_frame
from prism_jax.data.manifest import MANIFEST, hash_files
from prism_jax.data.recordings import (
    DEPTH_SCALE,
    LABELS,
    RecordedCells,
    RecordedFrame,
    check_recordings,
    read_frame,
)
from prism_jax.data.source import Source
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import NEARER, SURFACE, UNKNOWN, look_up
from prism_jax.io.errors import InputError

HEIGHT, WIDTH, FOCAL = 24, 32, 30.0


def camera():
    """One metre up, one and a half before the origin, looking along +x."""
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    intrinsics = np.array([[FOCAL, 0, 15.5], [0, FOCAL, 11.5], [0, 0, 1.0]])
    position = np.array([-1.5, 0.0, 1.0])
    return Camera(rotation, -rotation @ position, intrinsics, HEIGHT, WIDTH)


def frame(complete=True):
    """A wall in the plane x = 0, less a column without returns."""
    rng = np.random.default_rng(0)
    depth = np.full((HEIGHT, WIDTH), 6000, np.uint16)
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
    """Two sequences: a whole frame and a bare one; a bare one."""
    write_frame(tmp_path / "one", 0, frame())
    write_frame(tmp_path / "one", 12, frame(complete=False))
    write_frame(tmp_path / "two", 3, frame(complete=False))
    return tmp_path


def png(path, pixels, mode=None):
    buffer = io.BytesIO()
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(buffer, "PNG")
    path.write_bytes(buffer.getvalue())


def edit_camera(root, **changes):
    path = root / "one" / "000000.camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize("complete", [True, False])
def test_a_frame_comes_back_bit_for_bit(tmp_path, complete):
    written = frame(complete)
    write_frame(tmp_path, 7, written)
    assert has_frame(tmp_path, 7) and not has_frame(tmp_path, 8)
    read = read_frame(tmp_path, 7)
    for name in ("depth", "partial", "complete", "labels"):
        first, second = getattr(written, name), getattr(read, name)
        if first is None:
            assert second is None
        else:
            assert second.dtype == first.dtype
            np.testing.assert_array_equal(second, first)
    assert read.joints == written.joints
    np.testing.assert_array_equal(read.camera.rotation, written.camera.rotation)
    np.testing.assert_array_equal(read.camera.translation, written.camera.translation)
    np.testing.assert_array_equal(read.camera.intrinsics, written.camera.intrinsics)


def test_the_files_are_those_of_the_layout(root):
    assert sorted(hash_files(root)) == [
        "one/000000.camera.json",
        "one/000000.complete.ply",
        "one/000000.depth.png",
        "one/000000.joints.json",
        "one/000000.labels.png",
        "one/000000.partial.ply",
        "one/000012.camera.json",
        "one/000012.depth.png",
        "one/000012.partial.ply",
        "two/000003.camera.json",
        "two/000003.depth.png",
        "two/000003.partial.ply",
    ]
    with Image.open(root / "one" / "000000.depth.png") as image:
        assert image.mode == "I;16" and image.size == (WIDTH, HEIGHT)
    stored = json.loads((root / "one" / "000000.camera.json").read_text())
    assert stored["depth_scale"] == DEPTH_SCALE == 0.25e-3


def test_recordings_are_a_source_of_examples(root):
    cells = RecordedCells(root)
    assert isinstance(cells, Source)
    assert [example.name for example in cells] == [
        "one/000000",
        "one/000012",
        "two/000003",
    ]
    first, second = cells[0], cells[1]
    written = frame()
    np.testing.assert_array_equal(first.partial, written.partial)
    np.testing.assert_array_equal(first.complete, written.complete)
    np.testing.assert_allclose(first.eye, (-1.5, 0, 1), atol=1e-6)
    assert first.eye.dtype == np.float32
    assert second.complete is None
    assert {first.category, second.category} == set(cells.categories)
    with pytest.raises(IndexError):
        cells[3]
    assert check_recordings(root) == 3


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
    states, behind = look_up(
        known,
        np.array(
            [
                (0.1, 0.1, 1.0),  # behind the patch
                (-0.5, -0.167, 1.0),  # behind the post, which is at x = -1
                (0.5, 0.3, 1.0),  # behind the wall beside the patch
                (0.1, -1.4, 1.0),  # beside the map
            ]
        ),
    )
    np.testing.assert_array_equal(states, [SURFACE, NEARER, NEARER, UNKNOWN])
    np.testing.assert_allclose(behind[:3], [0.1, 0.5, 0.5], atol=0.05)


def test_a_frame_written_again_leaves_nothing_of_the_old_one(tmp_path):
    write_frame(tmp_path / "one", 0, frame())
    write_frame(tmp_path / "one", 0, frame(complete=False))
    assert len(hash_files(tmp_path)) == 3


def test_hidden_files_and_loose_files_are_passed_over(root):
    (root / "one" / ".000001.depth.png.123.tmp").write_bytes(b"half")
    (root / ".cache").mkdir()
    (root / "README.txt").write_text("recorded on Monday")
    assert check_recordings(root) == 3


@pytest.mark.parametrize("suffix", ["camera.json", "depth.png", "partial.ply"])
def test_half_a_frame_is_refused(root, suffix):
    path = root / "one" / f"000000.{suffix}"
    path.unlink()
    with pytest.raises(InputError, match=f"000000.{suffix}: file missing .* again"):
        RecordedCells(root)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("12.depth.png", "12.depth.png: name is not six digits"),
        ("000001.depth.png.part", "000001.depth.png.part: not one of"),
        ("000000.colour.png", "000000.colour.png: not one of"),
    ],
)
def test_files_out_of_the_layout_are_refused(root, name, message):
    (root / "one" / name).write_bytes(b"a")
    with pytest.raises(InputError, match=message):
        RecordedCells(root)


def test_a_folder_without_frames_is_refused(tmp_path):
    with pytest.raises(InputError, match="not a folder"):
        RecordedCells(tmp_path / "none")
    (tmp_path / "sequence").mkdir()
    with pytest.raises(InputError, match="no recorded frames; lay it out"):
        RecordedCells(tmp_path)


WALL = np.full((HEIGHT, WIDTH), 6000, np.uint16)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda r: png(r / "one/000000.depth.png", WALL[1:]),
            "depth.png.*32x23.*32x24",
        ),
        (
            lambda r: png(r / "one/000000.depth.png", WALL.astype(np.uint8)),
            "depth.png.*16-bit",
        ),
        (lambda r: png(r / "one/000000.depth.png", WALL * 0), "no valid depth pixels"),
        (
            lambda r: (r / "one/000000.depth.png").write_bytes(
                (r / "one/000000.depth.png").read_bytes()[:60]
            ),
            "depth.png: not a valid depth image",
        ),
        (lambda r: edit_camera(r, depth_scale=0.001), "camera.json: depth_scale is"),
        (lambda r: edit_camera(r, depth_scale=None), "camera.json.*depth_scale"),
        (lambda r: edit_camera(r, fx=-1), "camera.json.*positive"),
        (
            lambda r: edit_camera(r, translation=[0, 0, 0]),
            "partial.ply: 0 of 744 points match the depth image",
        ),
        (lambda r: png(r / "one/000000.labels.png", WALL), "labels.png: .*I;16"),
        (
            lambda r: png(r / "one/000000.labels.png", WALL[:, 1:].astype(np.uint8)),
            "labels.png: .*image is 31x24",
        ),
        (
            lambda r: png(r / "one/000000.labels.png", (0 * WALL + 9).astype(np.uint8)),
            "labels.png: invalid label 9",
        ),
        (lambda r: (r / "one/000000.labels.png").write_bytes(b"PNG"), "not a PNG"),
        (lambda r: (r / "one/000000.joints.json").write_text("[1]"), "not a JSON obj"),
        (lambda r: (r / "one/000000.joints.json").write_text("{"), "not JSON"),
        (lambda r: (r / "one/000000.partial.ply").write_bytes(b"ply"), "partial.ply"),
        (lambda r: (r / "one/000000.complete.ply").write_bytes(b"x"), "complete.ply"),
    ],
)
def test_files_that_do_not_fit_are_named(root, spoil, message):
    spoil(root)
    with pytest.raises(InputError, match=message):
        check_recordings(root)


@pytest.mark.parametrize("cloud", ["partial", "complete"])
def test_clouds_in_other_units_or_almost_empty_are_refused(tmp_path, cloud):
    whole = frame()
    points = np.asarray(getattr(whole, cloud))
    for spoilt, message in (
        (1000 * points, f"{cloud}.ply: extends to .* store metres"),
        (points[:5], f"{cloud}.ply: only 5 distinct points"),
        (points * np.float32(np.nan), f"{cloud}.ply: some points are not finite"),
    ):
        changed = {**vars(whole), cloud: spoilt}
        write_frame(tmp_path / "one", 0, RecordedFrame(**changed))
        with pytest.raises(InputError, match=message):
            check_recordings(tmp_path)


def manifest(root, files):
    (root / MANIFEST).write_text(json.dumps({"files": files}))


def test_files_are_held_against_the_manifest(root):
    files = hash_files(root)
    name = "one/000012.depth.png"
    assert files[name] == hashlib.sha256((root / name).read_bytes()).hexdigest()
    manifest(root, files)
    assert len(RecordedCells(root)) == 3

    png(root / name, WALL)
    with pytest.raises(InputError, match=f"{name}: differs from the manifest"):
        RecordedCells(root)
    assert len(RecordedCells(root, verify=False)) == 3

    manifest(root, hash_files(root) | {"two/000003.joints.json": "0" * 64})
    with pytest.raises(InputError, match=r"000003.joints.json: missing but in"):
        RecordedCells(root)
    manifest(root, {key: sha for key, sha in hash_files(root).items() if key != name})
    with pytest.raises(InputError, match=f"{name}: not in the manifest"):
        RecordedCells(root)
    manifest(root, None)
    with pytest.raises(InputError, match="incomplete: the build was interrupted"):
        RecordedCells(root)
    (root / MANIFEST).write_text("no JSON")
    with pytest.raises(InputError, match=r"manifest.json: not a valid manifest"):
        RecordedCells(root)


def test_the_recorded_cells_are_whole():
    cells = RecordedCells(CELLS)
    assert len(cells) == check_recordings(cells.root) == 12
    robots = set()
    for index, example in enumerate(cells):
        frame = cells.read(index)
        assert example.complete.shape == (16384, 3)
        assert len(example.partial) > 1000
        assert (frame.camera.width, frame.camera.height) == (640, 480)
        robots.add(frame.joints["robot"])
        assert set(np.unique(frame.labels)) <= set(LABELS.values())
        seen = np.isin(frame.labels, (LABELS["robot"], LABELS["fixture"]))
        assert 0.6 < len(example.partial) / np.count_nonzero(seen) <= 1
    assert len(robots) >= 6
    used = sum(path.stat().st_size for path in cells.root.rglob("*"))
    assert used < 10e6


def test_the_recorded_clouds_are_one_scene_in_one_frame():
    """What the camera saw lies on the ground truth, to both sensors' noise."""
    for example in RecordedCells(CELLS):
        distance, _ = cKDTree(example.complete).query(example.partial)
        assert np.median(distance) < 0.006
        assert np.mean(distance < 0.02) > 0.95
        assert example.complete[:, 2].min() > 0


def test_one_frame_ships_and_it_is_one_of_them():
    (ours,) = RecordedCells.bundled()
    first = RecordedCells(CELLS)[0]
    assert check_recordings(RecordedCells.bundled().root) == 1
    assert ours.name == first.name
    np.testing.assert_array_equal(ours.partial, first.partial)
