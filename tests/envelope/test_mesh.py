import io

import numpy as np
import pytest
import trimesh

from prism_jax.envelope.distance import Envelope, Surfaces
from prism_jax.envelope.mesh import (
    envelope_mesh,
    isosurface,
    stl_bytes,
    stl_origin,
)
from prism_jax.envelope.voxels import FREE, UNSEEN, Grid

FAR = np.array([400_000.0, -5_000_000.0, 120.0])


def loaded(data):
    return trimesh.load(io.BytesIO(data), file_type="stl")


def test_a_spheres_surface_closes_and_holds_its_volume():
    lattice = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1)
    values = np.linalg.norm(lattice - 11.3, axis=-1) - 8
    mesh = isosurface(values, np.zeros(3), 1.0)
    sphere = trimesh.Trimesh(*mesh, process=False)
    assert sphere.is_watertight and sphere.is_winding_consistent
    assert sphere.volume == pytest.approx(4 / 3 * np.pi * 8**3, rel=0.02)
    np.testing.assert_allclose(sphere.center_mass, 11.3, atol=0.01)


def test_the_surface_of_noise_closes_too():
    """Every case of a tetrahedron, and voxels that touch at edges and corners."""
    noise = np.random.default_rng(0).standard_normal((12, 12, 12))
    mesh = isosurface(np.pad(noise, 1, constant_values=1.0), FAR, 0.25)
    closed = trimesh.Trimesh(mesh.vertices - FAR, mesh.faces, process=False)
    assert closed.is_watertight and closed.is_winding_consistent
    assert closed.volume > 0


def test_without_anything_inside_there_is_no_surface():
    mesh = isosurface(np.ones((4, 4, 4)), np.zeros(3), 1.0)
    assert mesh.vertices.shape == mesh.faces.shape == (0, 3)
    assert len(stl_bytes(mesh, np.zeros(3), "empty")) == 84
    assert len(envelope_mesh(cell(points=())).faces) == 0


def cell(origin=0.0, points=((0.5, 0.5, 0.5),), margin=0.3):
    grid = Grid.over(np.zeros(3) + origin, np.ones(3) + origin, 0.05)
    state = np.full(grid.shape, UNSEEN, np.uint8)
    state[:11] = FREE
    cloud = np.array(points).reshape(-1, 3) + origin
    return Envelope(grid, state, Surfaces({"measured": cloud}), margin)


@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
def test_the_stl_is_watertight_and_holds_all_that_may_be_taken(origin):
    one = cell(origin)
    mesh, base = envelope_mesh(one), stl_origin(one)
    np.testing.assert_array_equal(base, origin)
    solid = loaded(stl_bytes(mesh, base, "x"))
    assert solid.is_watertight and solid.volume > 0
    rng = np.random.default_rng(1)
    points = one.grid.lower + rng.uniform(0, 1, (2000, 3))
    taken = one.state.ravel()[one.grid.index_of(points)] != FREE
    taken &= np.linalg.norm(points - origin - 0.5, axis=1) < 0.3
    assert taken.sum() > 50
    assert solid.contains(points[taken] - base).all()
    # Half of the ball is free, and taken away but for a voxel.
    beyond = points[(points - origin)[:, 0] < 0.45]
    assert not solid.contains(beyond - base).any()
    ball = 4 / 3 * np.pi * 0.3**3
    assert 0.5 * ball < solid.volume < 1.3 * 4 / 3 * np.pi * (0.3 + 0.087) ** 3


def test_an_envelope_that_fills_its_grid_closes_at_the_border():
    solid = loaded(stl_bytes(envelope_mesh(cell(margin=5.0)), np.zeros(3), "x"))
    assert solid.is_watertight
    lower, upper = solid.bounds
    assert (lower[1:] < 0).all() and (lower > -0.1).all()
    assert (upper > 1).all() and (upper < 1.1).all()
