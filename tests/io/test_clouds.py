"""Point clouds of any kind: the suffix decides, and what cannot be used is refused."""

import numpy as np
import pytest

from prism_jax.geometry.camera import Camera
from prism_jax.io import InputError, clouds, read_points
from prism_jax.io.clouds import check_cloud, check_in_view, rounding

POINTS = np.random.default_rng(0).normal(size=(80, 3)).astype(np.float32)


def test_points_that_are_not_finite_and_lost_returns_go(tmp_path):
    points = POINTS.copy()
    points[3, 1], points[10], points[20:60] = np.nan, np.inf, [0.0, -0.0, 0.0]
    np.save(tmp_path / "scan.npy", points)
    (tmp_path / "scan.npy").rename(tmp_path / "scan.NPY")
    read, num_read, notes = clouds.read_cloud(tmp_path / "scan.NPY")
    wanted = np.delete(POINTS, [3, 10, *range(20, 60)], axis=0)
    np.testing.assert_array_equal(read, wanted)
    np.testing.assert_array_equal(read_points(str(tmp_path / "scan.NPY")), read)
    assert num_read == 80
    assert notes == {"no_return": "40 of 80 points are at 0,0,0 and count as no return"}
    # What nobody measured may lie there.
    assert len(clouds.read_cloud(tmp_path / "scan.NPY", are_returns=False)[0]) == 78


def test_more_columns_are_told_and_a_column_that_counts_is_asked_for(tmp_path):
    table = np.concatenate([POINTS, np.ones((80, 1), np.float32)], axis=1)
    table.tofile(tmp_path / "a.bin")
    np.testing.assert_array_equal(read_points(tmp_path / "a.bin"), POINTS)
    for array in (table, table.reshape(8, 10, 4)):
        np.save(tmp_path / "a.npy", array)
        points, num_read, notes = clouds.read_cloud(tmp_path / "a.npy")
        np.testing.assert_array_equal(points, POINTS)
        assert num_read == 80
        assert "x, y and z; 1 more are left out" in notes["columns"]
    table[:, 0] = np.arange(80)
    np.save(tmp_path / "a.npy", table)
    with pytest.raises(InputError, match="counts the rows: which are x, y and z"):
        read_points(tmp_path / "a.npy")
    POINTS.tofile(tmp_path / "a.bin")
    with pytest.raises(InputError, match="no reflectance"):
        read_points(tmp_path / "a.bin")


def test_unknown_suffix_names_those_that_are_known_and_some_point_is_finite(tmp_path):
    for name in ("scan.doc", "scan", ".ply"):
        with pytest.raises(InputError, match=r"\.ply \.pcd \.npy \.npz \.xyz"):
            read_points(tmp_path / name)
    with pytest.raises(InputError, match="a mesh, not a scan; sample points"):
        read_points(tmp_path / "a.STL")
    np.save(tmp_path / "a.npy", np.full((80, 3), np.nan))
    with pytest.raises(InputError, match="no finite points;"):
        read_points(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.zeros((80, 3)))
    with pytest.raises(InputError, match="no finite points other than 0,0,0"):
        read_points(tmp_path / "a.npy")


def test_clouds_that_can_and_cannot_be_completed():
    double = POINTS.astype(np.float64)
    for points, fault in [
        (POINTS[:63], "63 distinct points, at least 64"),
        (np.tile(POINTS[:10], (50, 1)), "10 distinct points"),
        (np.ones((100, 3)), "zero extent"),
        (np.empty((0, 3)), "no points"),
        (np.full((100, 3), np.nan), "not finite"),
        (POINTS * 1e4, "above the limit of 10,000 units"),
        (double * 1e300, "above the limit of 10,000 units"),
    ]:
        with pytest.raises(InputError, match=fault):
            check_cloud(points, "scan.ply")
    check_cloud(POINTS[:64], "scan.ply")
    check_cloud(np.concatenate([np.ones((5000, 3), np.float32), POINTS]), "scan.ply")
    check_cloud(double * 1e-12, "scan.ply")
    check_cloud(double + 4e6, "scan.ply")
    check_cloud(np.linspace([0, 0, 0], [1e4, 0, 0], 64), "scan.ply")


def test_coordinates_of_few_steps_are_told_and_map_coordinates_are_not():
    """By what can be told apart at the largest of them, whatever type it is kept in."""
    assert rounding(POINTS) is rounding(POINTS.astype(np.float64) + 5.4e6) is None
    rounded = POINTS + np.float32(5.4e6)
    for points in (rounded, rounded.astype(np.float64)):
        assert "rounded to steps of 0.5, " in str(rounding(points))


def test_camera_must_see_something():
    intrinsics = np.array([[60.0, 0, 63.5], [0, 60, 63.5], [0, 0, 1]])
    camera = Camera(np.eye(3), np.zeros(3), intrinsics, 128, 128)
    ahead = np.abs(POINTS) * [0.1, 0.1, 1] + [0, 0, 1]
    check_in_view(ahead, camera, "scan.ply")
    check_in_view(np.concatenate([-ahead, ahead[:1]]), camera, "scan.ply")
    with pytest.raises(InputError, match="all points are behind the camera"):
        check_in_view(-ahead, camera, "scan.ply")
    ahead[:, 0] += 100
    with pytest.raises(InputError, match="no points in the camera's image"):
        check_in_view(ahead, camera, "scan.ply")
