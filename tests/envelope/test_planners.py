import json

import numpy as np
import octomap
import pytest

from prism_jax.envelope.distance import Envelope, Surfaces
from prism_jax.envelope.mesh import stl_origin
from prism_jax.envelope.planners import boxes_bytes, octomap_bytes
from prism_jax.envelope.voxels import FREE, UNSEEN, Grid
from prism_jax.io.errors import InputError
from tests.envelope.test_mesh import FAR, VOXEL, around


def blocks(lower):
    """Noise, with blocks of one state among it."""
    rng = np.random.default_rng(0)
    state = np.kron(rng.integers(0, 5, (3, 2, 2)), np.ones((8, 9, 10), int))
    state = np.where(rng.random(state.shape) < 0.1, np.roll(state, 11, 0), state)
    grid = Grid(np.array(lower), VOXEL, state.shape)
    return Envelope(grid, state.astype(np.uint8), Surfaces({}), 1.0)


@pytest.mark.parametrize("lower", [(-0.8, 0.4, 0.0), (-0.83, 0.4, 0.02), FAR])
def test_the_tree_is_what_octomap_makes_of_the_cells(lower):
    envelope = blocks(lower)
    grid, origin = envelope.grid, stl_origin(envelope)
    steps = np.indices([count + 2 for count in grid.shape]).reshape(3, -1).T - 0.5
    middles = VOXEL * (np.floor((grid.lower - origin) / VOXEL + 1e-6) + steps)
    corners = 0.998 * VOXEL * (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5)
    index = np.stack([grid.index_of(origin + middles + corner) for corner in corners])
    states = np.where(index < 0, UNSEEN, envelope.state.ravel()[index])
    tree, again = octomap.OcTree(VOXEL), octomap.OcTree(1.0)
    tree.updateNodes(middles[(states < UNSEEN).any(axis=0)], True)
    tree.updateNodes(middles[(states == FREE).all(axis=0)], False)
    head, _, body = octomap_bytes(envelope, origin).partition(b"data\n")
    assert body == tree.writeBinary().partition(b"data\n")[2]
    assert again.readBinary(head + b"data\n" + body) and again.size() == tree.size()
    assert again.getResolution() == VOXEL
    with pytest.raises(InputError, match="32,768 voxels from the origin"):
        octomap_bytes(envelope, origin + FAR)


@pytest.mark.parametrize(("share", "most"), [(0.0, 0), (0.5, 300), (1.0, 1)])
def test_boxes_are_the_envelopes_voxels_each_once(share, most):
    taken, lower = np.random.default_rng(0).random((9, 10, 11)) < share, (1.0, -2, 0.5)
    told = json.loads(boxes_bytes(around(taken, lower), "base_link"))
    assert told["frame_id"] == "base_link" and len(told["boxes"]) <= most
    times = np.zeros(taken.shape, int)
    for box in told["boxes"]:
        ends = (np.array([box["lower"], box["upper"]]) - lower) / VOXEL
        np.testing.assert_allclose(ends, ends.round(), atol=1e-9)
        times[tuple(map(slice, *ends.round().astype(int)))] += 1
    np.testing.assert_array_equal(times, taken)
