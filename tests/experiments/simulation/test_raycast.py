"""Rays at meshes, against plain NumPy and closed forms."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.raycast import VIEWPOINT_DIRECTIONS, Scene, sample_outside


def moeller_trumbore(
    triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance and index of each ray's first triangle, by plain NumPy; inf, -1: none.

    Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997).
    """
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    first, second = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
    across = np.cross(directions[:, None], second)
    scale = np.einsum("tk,rtk->rt", first, across)
    scale = np.where(np.abs(scale) < 1e-14, np.nan, scale)
    offset = origins[:, None] - triangles[:, 0]
    u = np.einsum("rtk,rtk->rt", offset, across) / scale
    other = np.cross(offset, first)
    v = np.einsum("rtk,rk->rt", other, directions) / scale
    distance = np.einsum("rtk,tk->rt", other, second) / scale
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    distance = np.where(inside, distance, np.inf)
    nearest = distance.min(axis=1)
    return nearest, np.where(np.isfinite(nearest), distance.argmin(axis=1), -1)


@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_first_hits_are_those_of_plain_numpy(shift):
    """On 40 loose random triangles."""
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(40, 1, 3)) + 0.4 * rng.normal(size=(40, 3, 3))
    faces = np.arange(120).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False)
    mesh.apply_translation((shift, 0, -shift))
    origins = rng.uniform(-3, 3, (600, 3)) + [shift, 0, -shift]
    aims = mesh.triangles_center[rng.integers(len(mesh.faces), size=600)]
    directions = aims + rng.normal(scale=0.3, size=(600, 3)) - origins
    hits = Scene(mesh).cast(origins, directions)
    expected, faces = moeller_trumbore(mesh.triangles, origins, directions)
    np.testing.assert_array_equal(hits.ray, np.flatnonzero(faces >= 0))
    assert 200 < len(hits.ray) < 500
    np.testing.assert_array_equal(hits.faces, faces[hits.ray])
    # Embree finds where by float32 barycentric coordinates of triangles of size 1.
    np.testing.assert_allclose(hits.distances, expected[hits.ray], atol=2e-5)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    points = origins + expected[:, None] * unit
    np.testing.assert_allclose(hits.points, points[hits.ray], atol=5e-5)


def test_seen_from_outside_agrees_with_plain_numpy():
    """Of a cup: for each point, lines to all viewpoints against every triangle."""
    wall = trimesh.creation.annulus(0.5, 0.6, 1.4)
    floor = trimesh.creation.cylinder(0.55, 0.1).apply_translation((0, 0, -0.65))
    scene = Scene(trimesh.util.concatenate([wall, floor]))
    points, faces = trimesh.sample.sample_surface(scene.mesh, 60, seed=3)
    points, normals = np.asarray(points), scene.mesh.face_normals[faces]
    seen = scene.seen_from_outside(points, normals)
    eyes = scene.center + 3 * scene.radius * VIEWPOINT_DIRECTIONS
    for point, normal, is_seen in zip(points, normals, seen, strict=True):
        start = np.tile(point + 1e-4 * scene.radius * normal, (len(eyes), 1))
        _, blocked = moeller_trumbore(scene.triangles, start, eyes - start)
        assert is_seen == np.any(blocked < 0)
    assert 5 < seen.sum() < 60


@pytest.mark.parametrize("two_sided", [False, True])
def test_samples_are_uniform_on_what_is_seen(two_sided):
    """Faces of a hollow box get points by area, none inside: a chi-square test."""
    inner = trimesh.creation.box((1, 1, 1))
    inner.invert()
    mesh = trimesh.util.concatenate([trimesh.creation.box((2, 2, 2)), inner])
    if two_sided:  # every other triangle is wound the other way
        faces = np.array(mesh.faces)
        faces[::2] = faces[::2, ::-1]
        mesh = trimesh.Trimesh(mesh.vertices, faces, process=False)
    points = sample_outside(Scene(mesh), 12000, np.random.default_rng(4), two_sided)
    assert points.shape == (12000, 3)
    largest = np.abs(points).argmax(axis=1)
    np.testing.assert_allclose(np.abs(points).max(axis=1), 1, atol=1e-12)
    sides = 2 * largest + (np.take_along_axis(points, largest[:, None], 1)[:, 0] > 0)
    across = np.take_along_axis(points, (largest[:, None] + 1) % 3, 1)[:, 0] > 0.3
    counts = np.bincount(2 * sides + across, minlength=12).reshape(6, 2)
    expected = 2000 * np.array([0.65, 0.35])
    assert np.sum((counts - expected) ** 2 / expected) < 31.3  # 11 degrees, p = 0.001
