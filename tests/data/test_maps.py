"""Maps in 16 bits a pixel: what comes back, and how exactly."""

import jax
import numpy as np
import pytest

from experiments.simulation.shard_writer import encode
from prism_jax.data.shards import decode
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import UNKNOWN, Visibility, nothing_known


def random_map(near: float, far: float) -> Visibility:
    rng = np.random.default_rng(0)
    camera = Camera.look_at((2.0, -3, 1), (0.1, 0, 0.2), height=20, width=24)
    camera = jax.tree.map(np.asarray, camera)
    state = rng.integers(0, 4, (20, 24)).astype(np.uint8)
    depth = np.exp(rng.uniform(np.log(near), np.log(far), state.shape))
    depth = np.where(state == UNKNOWN, 0, depth).astype(np.float32)
    return Visibility(camera, state, depth)


@pytest.mark.parametrize(("near", "far"), [(0.3, 15), (40, 400), (1, 1)])
def test_states_and_camera_come_back_and_depths_to_half_a_step(near, far):
    given = random_map(near, far)
    pixels, view = encode(given)
    assert (pixels.dtype, view.dtype) == (np.uint16, np.float32)
    found = decode(pixels, view)
    for name in ("rotation", "translation", "intrinsics", "height", "width"):
        expected = getattr(given.camera, name)
        np.testing.assert_array_equal(getattr(found.camera, name), expected)
    np.testing.assert_array_equal(found.state, given.state)
    known = given.state != UNKNOWN
    assert np.all(found.depth[~known] == 0)
    # Half a step of the logarithm, and the rounding of single precision.
    bound = 0.5 * np.log(far / near) / (2**14 - 1) + 5e-7
    error = np.log(found.depth[known].astype(float) / given.depth[known])
    assert np.abs(error).max() <= bound
    # Packed again, nothing is lost.
    again, same = encode(found)
    assert np.abs(again.astype(int) - pixels).max() <= 1
    np.testing.assert_allclose(same, view, rtol=1e-6)


def test_maps_of_no_known_pixel_and_of_one_come_back():
    nothing = nothing_known(4)
    state, depth = nothing.state.copy(), nothing.depth.copy()
    state[1, 2], depth[1, 2] = 3, 7.3
    for given in (nothing, nothing._replace(state=state, depth=depth)):
        found = decode(*encode(given))
        np.testing.assert_array_equal(found.state, given.state)
        np.testing.assert_array_equal(found.depth, given.depth)
