import io

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation

from prism_jax.envelope import mesh
from prism_jax.envelope.distance import Envelope, Surfaces
from prism_jax.envelope.voxels import FREE, UNSEEN, Grid

FAR = np.array([400_000.0, -5_000_000.0, 120.0])
VOXEL = 0.05


def around(taken, lower=(0, 0, 0)):
    """An envelope of just these voxels."""
    grid = Grid(np.array(lower, float), VOXEL, taken.shape)
    state = np.where(taken, UNSEEN, FREE).astype(np.uint8)
    return Envelope(grid, state, Surfaces({"measured": grid.lower[None]}), 100.0)


def loaded(envelope):
    origin = mesh.stl_origin(envelope)
    data = mesh.stl_bytes(mesh.envelope_mesh(envelope), origin, "x")
    return trimesh.load(io.BytesIO(data), file_type="stl")


@pytest.mark.parametrize(("lower", "origin"), [((-1, 0.3, 7), (0, 0, 0)), (FAR, FAR)])
def test_a_ball_closes_and_holds_its_voxels_and_no_other(lower, origin):
    steps = np.stack(np.indices((20, 22, 24)), axis=-1)
    envelope = around(np.linalg.norm(steps - 10.2, axis=-1) < 8, lower)
    solid = loaded(envelope)
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(4 / 3 * np.pi * (8 * VOXEL) ** 3, rel=0.02)
    held = solid.contains(envelope.grid.centers() - origin)
    np.testing.assert_array_equal(held, envelope.taken.ravel())


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 1.0])
def test_noise_closes_with_voxels_where_others_touch_at_edges(share):
    taken = np.pad(np.random.default_rng(0).random((16, 14, 12)) < share, 3)
    filled = mesh.without_contacts(taken)
    assert (filled >= taken).all() and filled[3:-3, 3:-3, 3:-3].sum() == filled.sum()
    assert (filled <= binary_dilation(taken, np.ones((5, 5, 5)))).all()
    solid = loaded(around(taken))
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(filled.sum() * VOXEL**3, rel=1e-4)


def test_one_voxel_is_a_cube_and_none_is_nothing():
    taken = np.zeros((3, 4, 5), bool)
    assert len(mesh.stl_bytes(mesh.envelope_mesh(around(taken)), FAR, "empty")) == 84
    taken[1, 2, 4] = True
    cube = loaded(around(taken))
    assert len(cube.faces) == 12 and cube.is_watertight
    np.testing.assert_allclose(cube.bounds, VOXEL * np.array([[1, 2, 4], [2, 3, 5]]))
