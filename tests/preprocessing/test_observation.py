"""Points and a sensor to what the network reads, and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.sampling import resample
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.models.config import ModelConfig
from prism_jax.preprocessing.observation import FAR_ORIGIN, UNKNOWN_EYE, observe, padded
from prism_jax.preprocessing.upright import UP_AXES

MODEL = ModelConfig()
EYE = np.array([3.0, -2.0, 1.5])
FAR = np.array([4e5, 5e6, 100.0])


def cloud(count=300, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 3)) * [0.75, 0.5, 0.4] + [0.1, 0, 0]


def test_the_cube_around_the_points_is_the_workspace():
    points = cloud()
    seen = observe(points, EYE, MODEL)
    expected = Workspace.from_points(points, 1.4)
    assert np.array_equal(seen.partial, expected.to_unit(points))
    assert np.array_equal(seen.eye, expected.to_unit(EYE))
    assert seen.inside.all() and seen.sensor_known
    assert np.abs(seen.partial).max() == pytest.approx(1 / 1.4)
    np.testing.assert_allclose(seen.workspace.from_unit(seen.partial), points)
    # Far from the origin as near it: in double precision, whatever the points are in.
    far = observe(points + FAR, EYE + FAR, MODEL)
    np.testing.assert_allclose(far.partial, seen.partial, rtol=0, atol=1e-8)
    np.testing.assert_allclose(far.eye, seen.eye, rtol=0, atol=1e-8)
    assert far.partial.dtype == far.eye.dtype == np.float64
    assert observe(points.astype(np.float32), EYE, MODEL).partial.dtype == np.float64


def test_the_view_is_at_the_eye_and_filled_by_the_partial():
    seen = observe(cloud(), EYE, MODEL)
    np.testing.assert_allclose(seen.camera.position, seen.eye, atol=1e-5)
    pixels, depth = seen.camera.project(jnp.asarray(seen.partial, jnp.float32))
    assert (depth > 0).all()
    assert np.abs(np.asarray(pixels) - 63.5).max() == pytest.approx(64 / 1.3, rel=1e-3)
    assert seen.camera.rotation.dtype == jnp.float32


@pytest.mark.parametrize("up", UP_AXES)
def test_up_is_up_in_the_workspace_and_undone_on_the_way_back(up):
    top = (-1.0 if up[0] == "-" else 1.0) * np.eye(3)["xyz".index(up[-1])]
    points = cloud() + FAR
    seen = observe(points, FAR + 3 * top, MODEL, up)
    assert np.array_equal(seen.eye.round(6).argmax(), 2)
    flat = seen.partial - seen.partial.mean(0)
    heights = (points - points.mean(0)) @ top
    half_extent = seen.workspace.half_extent
    np.testing.assert_allclose(flat[:, 2] * half_extent, heights, atol=1e-8)
    back = seen.workspace.from_unit(seen.partial)
    np.testing.assert_allclose(back, points, rtol=0, atol=1e-8)
    camera = seen.camera_to_user(seen.camera)
    np.testing.assert_allclose(camera.position - FAR, 3 * top, atol=1e-5)
    same = camera.rotation @ camera.rotation.T
    np.testing.assert_allclose(same, np.eye(3), atol=1e-14)
    in_user = camera.to_camera(points) / half_extent
    in_unit = seen.camera.to_camera(seen.partial.astype(np.float32))
    np.testing.assert_allclose(in_user, in_unit, atol=1e-5)


def test_a_given_workspace_crops():
    points = cloud()
    corner = Workspace(np.array([0.5, 0.2, 0.0]), np.array(0.3))
    seen = observe(points, EYE, corner)
    expected = (np.abs(points - corner.center) <= 0.3).all(-1)
    assert np.array_equal(seen.inside, expected)
    assert 20 < expected.sum() < 200
    assert np.array_equal(seen.partial, corner.to_unit(points))
    # One that came back is the same again; as JAX arrays it is still double precision.
    first = observe(points + FAR, EYE + FAR, MODEL, "y")
    again = observe(points + FAR, EYE + FAR, first.workspace)
    assert np.array_equal(first.partial, again.partial)
    single = jax.tree.map(jnp.asarray, corner)
    assert observe(points, EYE, single).partial.dtype == np.float64


def test_strays_do_not_decide_the_workspace():
    points = np.concatenate([cloud(948), cloud(5) + [300, 0, 0]])
    expected, seen = (observe(p, EYE, MODEL) for p in (cloud(948), points))
    assert np.array_equal(seen.inside, np.arange(953) < 948)
    assert np.array_equal(seen.partial[:948], expected.partial)
    assert np.array_equal(seen.eye, expected.eye)

    # With a margin of one, rounding puts some of those that decide beyond a face.
    for seed in range(8):
        points = (cloud(seed=seed) + 37).astype(np.float32)
        assert observe(points, EYE, ModelConfig(margin=1.0)).inside.all()


@pytest.mark.parametrize(
    ("share", "known"), [(0.0, False), (0.99, False), (1.01, True), (99, True)]
)
def test_an_origin_among_the_points_or_far_away_is_no_sensor(share, known):
    workspace = Workspace(share * np.array([0.5, 0, 0]), np.array(0.5))
    points = 0.5 * cloud() + workspace.center
    seen = observe(points, "origin", workspace)
    assert seen.sensor_known == known
    assert np.allclose(seen.eye, [-share, 0, 0] if known else UNKNOWN_EYE)
    given = observe(points, np.zeros(3), workspace)
    assert given.sensor_known and np.allclose(given.eye, [-share, 0, 0])
    beyond = observe(points + [FAR_ORIGIN, 0, 0], "origin", MODEL)
    assert not beyond.sensor_known
    for sensor in (None, np.full(3, np.nan), [0.0, np.inf, 0]):
        seen = observe(points, sensor, workspace)
        assert np.array_equal(seen.eye, UNKNOWN_EYE) and not seen.sensor_known


def test_one_place_is_observed_and_no_points_are_refused():
    for points in (np.ones((1, 3)), np.full((200, 3), 7.0)):
        seen = observe(points, EYE, MODEL)
        assert np.array_equal(seen.partial, 0 * points)
        assert seen.workspace.half_extent == 1 and seen.inside.all()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(seen.camera))
    for array in (np.zeros, jnp.zeros):
        with pytest.raises(ValueError, match="empty cloud"):
            observe(array((0, 3)), EYE, MODEL)
    with pytest.raises(InputError, match="up=north: no such axis; use one of x, y, z"):
        observe(cloud(), EYE, MODEL, "north")


def test_jit_and_vmap_agree_with_numpy():
    """Strays, a sensor that is unknown and another axis among them."""
    clouds = np.stack([cloud(seed=seed) for seed in range(3)]).astype(np.float32)
    clouds[1, 0] = 300
    eyes = np.stack([EYE, EYE, np.full(3, np.nan)]).astype(np.float32)

    @jax.jit
    @jax.vmap
    def traced(points, eye):
        seen = observe(points, eye, MODEL, up="-y").filled()
        at_origin = [observe(p, "origin", MODEL) for p in (points + 5, points)]
        return seen, seen.camera, [known.sensor_known for known in at_origin]

    found, cameras, at_origin = traced(clouds, eyes)
    assert at_origin[0].all() and not at_origin[1].any()
    for i in range(3):
        seen = observe(clouds[i], eyes[i], MODEL, up="-y")
        assert np.array_equal(found.inside[i], seen.inside)
        assert found.sensor_known[i] == seen.sensor_known
        expected = seen.filled()
        for one, other in (
            (found.partial, expected.partial),
            (found.eye, expected.eye),
            (found.workspace.half_extent, expected.workspace.half_extent),
            (cameras.rotation, expected.camera.rotation),
        ):
            np.testing.assert_allclose(one[i], other, rtol=1e-6, atol=1e-6)
    assert [int(n) for n in (~found.inside).sum(-1)] == [0, 1, 0]
    # A copy of the first point inside, and inside itself.
    assert np.array_equal(found.partial[1, 0], found.partial[1, 1])


def test_gradients_reach_points_and_sensor(x64):
    @jax.jit
    def total(points, eye):
        seen = observe(points, eye, MODEL, "y")
        return (seen.partial**2).sum() + (seen.eye * jnp.arange(3.0)).sum()

    points, eye = jnp.asarray(cloud(20)), jnp.asarray(EYE)
    for number, gradient in enumerate(jax.jit(jax.grad(total, (0, 1)))(points, eye)):
        step = 1e-6 * np.random.default_rng(1).normal(size=gradient.shape)
        ends = [[points, eye], [points, eye]]
        ends[0][number], ends[1][number] = (ends[0][number] + s for s in (step, -step))
        difference = total(*ends[0]) - total(*ends[1])
        np.testing.assert_allclose((gradient * step).sum() * 2, difference, rtol=1e-5)


@pytest.mark.parametrize("count", [1, 63, 64, 129])
def test_any_number_of_points_is_sampled_as_by_itself(count):
    """Copies that fill up a fixed shape change nothing, other points' twins neither."""
    points = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    points[count // 2 :] = points[: count - count // 2]
    assert np.array_equal(padded(points)[:count], points)
    assert (padded(points)[count:] == points[0]).all()
    assert len(padded(points)) == {1: 1, 63: 64, 64: 64, 129: 256}[count]
    cube = Workspace(np.zeros(3), 8.0)
    stray = np.full((2, 3), 300, np.float32)
    seen = observe(np.concatenate([stray, points]), np.full(3, 9.0), cube).sampled(64)
    wanted = resample(jnp.asarray(cube.to_unit(points), np.float32), 64)
    np.testing.assert_array_equal(seen.partial, wanted)
    assert seen.partial.dtype == np.float32 and seen.inside.shape == (64,)
