"""Scans as users hand them in."""

import json

import numpy as np
import plyfile
import pytest
from PIL import Image

from prism_jax.io import InputError, parse_bounds, read_depth, read_scan
from prism_jax.io.scan import standing_at
from prism_jax.io.streams.frame import Frame

POINTS = np.random.default_rng(0).uniform(-1, 1, size=(300, 3)).astype(np.float32)
CAMERA = {"width": 20, "height": 10, "fx": 9, "fy": 9, "cx": 9.5, "cy": 4.5}


@pytest.fixture
def cloud(tmp_path):
    points = POINTS.copy()
    points[:5] = np.nan
    np.save(tmp_path / "scan.npy", points)
    return tmp_path / "scan.npy"


@pytest.fixture
def depth_image(tmp_path):
    counts = np.full((10, 20), 2000, np.uint16)
    counts[:2] = 0
    Image.fromarray(counts).save(tmp_path / "scan.png")
    (tmp_path / "scan.json").write_text(json.dumps({**CAMERA, "depth_scale": 1e-3}))
    return tmp_path / "scan.png"


def test_a_whole_cloud_and_a_crop_that_keeps_the_faces_of_the_box(cloud):
    scan = read_scan(cloud)
    np.testing.assert_array_equal(scan.points, POINTS[5:])
    assert scan.points.dtype == np.float32 and scan.around is scan.camera is None
    assert (scan.num_not_finite, scan.num_outside) == (5, 0)
    face = float(np.median(POINTS[5:, 0]))
    scan = read_scan(cloud, bounds=parse_bounds(f"-1,-1,-1,{face!r},1,1"))
    np.testing.assert_array_equal(scan.points, POINTS[5:][POINTS[5:, 0] <= face])
    assert face in scan.points[:, 0]
    assert len(scan.points) + scan.num_outside == 295
    np.testing.assert_array_equal(scan.around, POINTS[5:][POINTS[5:, 0] > face])


@pytest.mark.parametrize("text", [False, True])
def test_what_a_ply_has_of_each_point_goes_along_and_faces_are_told(tmp_path, text):
    """Of the points that are kept, under its names and in its types."""
    points, count, lines = POINTS.copy(), np.arange(300), []
    points[:5] = np.nan
    columns = {"red": count.astype("u1"), "nx": POINTS[:, 0] + 1, "time": count / 7}
    table = dict(zip("xyz", points.T, strict=True)) | columns
    rows = np.rec.fromarrays(list(table.values()), names=list(table))
    vertices = plyfile.PlyElement.describe(np.array(rows), "vertex")
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    faces = plyfile.PlyElement.describe(faces, "face")
    plyfile.PlyData([vertices, faces], text=text).write(tmp_path / "a.ply")
    bounds = parse_bounds("-1,-1,-1,0,1,1")
    scan = read_scan(tmp_path / "a.ply", bounds=bounds, tell=lines.append)
    kept = (POINTS[:, 0] <= 0) & (count >= 5)
    np.testing.assert_array_equal(scan.points, POINTS[kept])
    assert [*scan.fields] == [*columns] and "a mesh of 1 faces, not a" in lines[0]
    for name, column in columns.items():
        np.testing.assert_array_equal(scan.fields[name], column[kept])
        assert scan.fields[name].dtype == column.dtype


def test_of_a_depth_image_all_that_was_cropped_away_is_around(depth_image):
    """Pixels without a return are no points, neither inside nor around."""
    whole = read_scan(depth_image).points
    scan = read_scan(depth_image, bounds=parse_bounds("0,-9,-9,9,9,9"))
    np.testing.assert_array_equal(scan.points, whole[whole[:, 0] >= 0])
    np.testing.assert_array_equal(scan.around, whole[whole[:, 0] < 0])
    assert len(whole) == 8 * 20 and len(scan.around) == 8 * 10


def test_crops_that_leave_too_little_and_boxes_that_are_none(cloud):
    for box, fault in (
        ("5,5,5,6,6,6", "no points inside --workspace; the points span -0.9"),
        ("-1,-1,-1,-0.5,0,0", "distinct points, at least 64 .*--workspace"),
    ):
        with pytest.raises(InputError, match=fault):
            read_scan(cloud, bounds=parse_bounds(box))
    for text in ("", "1,2,3", "0,0,0,1,1,x", "0,0,0,1,1,0", "0,0,0,1,1,nan"):
        with pytest.raises(InputError, match=r"^--workspace: .*x0,y0,z0,x1,y1,z1"):
            parse_bounds(text)


def test_cloud_with_a_camera(cloud, tmp_path):
    posed = {**CAMERA, "translation": [0, 0, 3]}
    (tmp_path / "c.json").write_text(json.dumps(posed))
    scan = read_scan(cloud, tmp_path / "c.json")
    assert scan.camera is not None
    np.testing.assert_array_equal(scan.camera.translation, [0, 0, 3])
    posed["translation"] = [0, 0, -3]
    (tmp_path / "c.json").write_text(json.dumps(posed))
    with pytest.raises(InputError, match=r"scan\.npy: all points are behind"):
        read_scan(cloud, tmp_path / "c.json")


def test_a_camera_that_only_stands_somewhere():
    camera = standing_at(np.array([10.0, 5.0, 1.2]))
    np.testing.assert_allclose(camera.position, [10, 5, 1.2])
    np.testing.assert_allclose(-camera.rotation[1], [0, 0, 1])


def test_depth_image_with_its_camera_beside_or_named(depth_image, tmp_path):
    scan = read_scan(depth_image)
    assert scan.points.shape == (160, 3)
    np.testing.assert_allclose(scan.points[:, 2], 2.0)
    assert scan.camera is not None and scan.in_camera_frame
    assert (scan.num_not_finite, scan.num_outside) == (0, 0)
    (tmp_path / "scan.json").rename(tmp_path / "other.json")
    with pytest.raises(InputError, match=r"without a camera; set --camera"):
        read_scan(depth_image)
    named = read_scan(depth_image, tmp_path / "other.json")
    np.testing.assert_array_equal(named.points, scan.points)
    Image.fromarray(np.zeros((10, 20), np.uint16)).save(depth_image)
    with pytest.raises(InputError, match="no valid depth pixels"):
        read_scan(depth_image, tmp_path / "other.json")


def test_a_depth_scale_that_is_its_inverse_is_the_fault(depth_image):
    camera = json.dumps({**CAMERA, "depth_scale": 5000})
    depth_image.with_suffix(".json").write_text(camera)
    lines = []
    with pytest.raises(InputError, match=r"scan.json: depth_scale 5000, .* extent 2"):
        read_scan(depth_image, tell=lines.append)
    assert "depths are up to 10,000,000 by depth_scale 5000" in lines[0]


def test_the_largest_value_of_an_image_is_no_return(depth_image):
    """Of PNGs as of every encoding of streams, like what is not finite or negative."""
    whole, lines = read_scan(depth_image), []
    counts = np.full((10, 20), 2000, np.uint16)
    counts[:2] = 65535
    Image.fromarray(counts).save(depth_image)
    scan = read_scan(depth_image, tell=lines.append)
    np.testing.assert_array_equal(scan.points, whole.points)
    assert scan.num_not_finite == 40
    assert lines == [
        f"{depth_image}: 40 pixels of the largest value count as no return"
    ]
    depth, mask, camera = read_depth(depth_image, depth_image.with_suffix(".json"))
    assert not depth[:2].any() and not mask[:2].any() and mask[2:].all()
    metres = depth.astype(np.float32)
    for lost in (np.inf, -np.inf, -1.0, np.nan):
        metres[:2] = lost
        frame = Frame.of_depth(metres, camera, 0)
        np.testing.assert_array_equal(frame.depth, depth.astype(np.float32))
        assert frame.num_not_finite == 40 and len(frame.points) == 160
        assert bool(frame.notes) == (not np.isnan(lost))


def test_real_scans(real):
    for name, count in (
        ("ouster/single_frame_zm_scan0.npz", 47_311),
        ("kitti/frame_0_car_0.pcd", 1_524),
        ("kinect/mosd_test24.pcd", 185_257),
        ("bunny/raw_scan_000.ply", 40_256),
        ("shapenet/airplane_partial_2048.ply", 2_048),
    ):
        scan = read_scan(real(name))
        assert scan.points.shape == (count, 3)
        assert scan.points.dtype == np.float32
