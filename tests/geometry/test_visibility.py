"""Visibility: closed forms, points that have no image, mirror images."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import (
    BACKGROUND,
    MAP_SIZE,
    NEARER,
    SURFACE,
    UNKNOWN,
    Visibility,
    look_up,
    mirrored,
    nearest_marked,
    nothing_known,
    seen_by,
    visibility_features,
)


def view_along_x() -> Visibility:
    """Three columns of two pixels, one unit wide at depth one, from the origin along x.

    From left to right: a surface at depth 2, something nearer at 1, and above nothing
    known, below a wall at 5.
    """
    camera = Camera(
        rotation=np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.float32),
        translation=np.zeros(3, np.float32),
        intrinsics=np.array([[1, 0, 1], [0, 1, 0.5], [0, 0, 1]], np.float32),
        height=2,
        width=3,
    )
    state = np.array(
        [[SURFACE, NEARER, UNKNOWN], [SURFACE, NEARER, BACKGROUND]], np.uint8
    )
    depth = np.array([[2, 1, 0], [2, 1, 5]], np.float32)
    return Visibility(camera, state, depth)


POINTS = np.array(
    [
        (2.5, 2.5, 1),  # upper left, half a unit behind the surface
        (1.5, 1.5, 0.1),  # upper left, half a unit in front of it
        (3.0, 0.0, -1),  # lower middle, two units behind what is nearer
        (2.0, -2, 0.5),  # upper right, where nothing is known
        (2.0, -2, -0.5),  # lower right, three units in front of the wall
        (2.0, -4, -0.5),  # beside the image
        (-2.0, 0, 0),  # behind the camera
        (0.0, 0, 0),  # at the camera
    ],
    np.float32,
)
STATES = [SURFACE, SURFACE, NEARER, UNKNOWN, BACKGROUND, UNKNOWN, UNKNOWN, UNKNOWN]
BEHIND = [0.5, -0.5, 2, 0, -3, 0, 0, 0]


look = jax.jit(look_up)


def test_state_and_depth_behind_in_closed_form():
    view = view_along_x()
    state, behind = look_up(view, POINTS)
    assert isinstance(state, np.ndarray) and isinstance(behind, np.ndarray)
    assert state.dtype == np.uint8 and behind.dtype == np.float32
    moved = dataclasses.replace(
        view.camera, translation=np.array([0, 0, -0.25], np.float32)
    )
    both = jax.tree.map(lambda *rows: np.stack(rows), view, view._replace(camera=moved))
    mapped = jax.jit(jax.vmap(look_up, (0, None)))(both, POINTS)
    np.testing.assert_allclose(mapped[1][1, 2], 1.75, atol=1e-6)
    for found in ((state, behind), look(view, POINTS), [rows[0] for rows in mapped]):
        np.testing.assert_array_equal(found[0], STATES)
        np.testing.assert_allclose(found[1], BEHIND, atol=1e-6)
    for rows in look_up(nothing_known(5), POINTS):
        assert np.all(rows == 0)


def test_points_that_are_not_finite_are_unknown():
    points = POINTS.copy()
    points[0], points[1] = np.nan, np.inf
    for found in (look_up(view_along_x(), points), look_up(view_along_x(), points[:0])):
        assert np.all(found[0][:2] == UNKNOWN) and np.all(found[1][:2] == 0)
    gradient = jax.jit(jax.grad(lambda x: look_up(view_along_x(), x)[1].sum()))
    # Depth is along x here, and the two that are not finite have none.
    expected = [0, 0, 1, 0, 1, 0, 0, 0]
    np.testing.assert_allclose(gradient(jnp.asarray(points))[:, 0], expected, atol=1e-6)


def test_a_mirror_image_knows_the_same_of_mirrored_points():
    """Of any pose, of an image of any middle, and with skew."""
    rng = np.random.default_rng(1)
    camera = Camera(
        rotation=Rotation.random(rng=rng).as_matrix(),
        translation=rng.normal(size=3) + [0, 0, 4.0],
        intrinsics=np.array([[9.0, 0.4, 7.1], [0, 11, 5.3], [0, 0, 1]]),
        height=12,
        width=17,
    )
    view = Visibility(
        camera,
        rng.integers(0, 4, (12, 17)).astype(np.uint8),
        rng.uniform(1, 5, (12, 17)).astype(np.float32),
    )
    points = rng.uniform(-2, 2, (500, 3))
    expected = look_up(view, points)
    stacked = mirrored(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), view))
    image = jax.tree.map(lambda leaf: leaf[1], stacked)
    np.testing.assert_allclose(np.linalg.det(image.camera.rotation), 1, atol=1e-6)
    state, behind = look_up(image, points * [-1, 1, 1])
    assert np.sum(expected[0] != UNKNOWN) > 100
    np.testing.assert_array_equal(state, expected[0])
    np.testing.assert_allclose(behind, expected[1], atol=1e-5)
    again = jax.tree.leaves(mirrored(image))
    for found, given in zip(again, jax.tree.leaves(view), strict=True):
        np.testing.assert_allclose(found, given, atol=1e-5)


def test_the_nearest_marked_pixel_is_scipys():
    find = jax.jit(nearest_marked)
    for share in (0.002, 0.1, 1.0):
        marked = np.random.default_rng(0).random((20, 31)) < share
        apart, nearest = find(jnp.asarray(marked))
        expected = distance_transform_edt(~marked)
        np.testing.assert_allclose(apart, expected, rtol=1e-6)
        rows, columns = np.divmod(np.asarray(nearest), 31)
        assert marked[rows, columns].all()
        away = np.hypot(*(np.indices(marked.shape) - [rows, columns]))
        np.testing.assert_allclose(away, expected, rtol=1e-6)
    assert np.isinf(find(jnp.zeros((20, 31), bool))[0]).all()


def sphere(count):
    """Half of one around the origin, evenly: what a sensor far along x sees of it."""
    turns = np.pi * (1 + 5**0.5) * np.arange(count)
    x = 1 - (np.arange(count) + 0.5) / count
    flat = np.sqrt(1 - x**2)
    points = np.stack([x, flat * np.cos(turns), flat * np.sin(turns)], axis=1)
    return jnp.asarray(points, jnp.float32)


FAR_EYE = np.array([20.0, 0, 0])

see = jax.jit(seen_by, static_argnums=2)
read = jax.jit(visibility_features)


def test_a_cloud_by_itself_tells_its_surface_and_no_more():
    known = see(sphere(400), FAR_EYE)
    inside = np.hypot(*(np.indices((MAP_SIZE, MAP_SIZE)) - 31.5)) * 1.4 / 32
    state = np.asarray(known.state)
    assert (state[inside < 0.95] == SURFACE).all()  # the holes are closed
    assert (state[inside > 1.05] == UNKNOWN).all()
    # The nearest point lies within a spacing of 0.1, where the sphere falls off less.
    middle = inside < 0.6
    expected = 20 - np.sqrt(1 - np.minimum(inside, 0.6) ** 2)
    np.testing.assert_allclose(known.depth[middle], expected[middle], atol=0.08)
    assert (np.asarray(known.depth)[state == UNKNOWN] == 0).all()
    # What lies around can be known to be empty.
    empty = see(sphere(400), FAR_EYE, "empty")
    around = np.where(state == SURFACE, SURFACE, BACKGROUND)
    np.testing.assert_array_equal(empty.state, around)
    assert (np.asarray(empty.depth)[around == BACKGROUND] >= 39.9).all()


def test_a_gap_wider_than_the_spacing_stays_open():
    """A ring as wide as its hole."""
    points = np.asarray(sphere(2000))
    ring = jnp.asarray(points[np.hypot(points[:, 1], points[:, 2]) > 0.5])
    state = np.asarray(see(ring, FAR_EYE, "empty").state)
    inside = np.hypot(*(np.indices(state.shape) - 31.5)) * 1.4 / 32
    assert (state[inside < 0.4] == BACKGROUND).all()
    assert (state[(inside > 0.6) & (inside < 0.9)] == SURFACE).all()


def test_mapped_maps_are_those_of_each():
    clouds = jnp.stack([sphere(400), 0.5 * sphere(400)])
    eyes = jnp.asarray([FAR_EYE, [5.0, 1, 1]], jnp.float32)
    both = jax.jit(jax.vmap(seen_by))(clouds, eyes)
    for row in range(2):
        alone = see(clouds[row], eyes[row])
        assert (both.state[row] == alone.state).mean() > 0.999  # rounding at edges
        np.testing.assert_allclose(both.camera.intrinsics[row], alone.camera.intrinsics)


def test_clues_in_closed_form():
    """At the middles of pixels; the map is as wide as one unit a pixel at depth one."""
    middle = [(2.5, 2.5, 1.25), (1.5, 1.5, 0.75), (2.0, 0.0, 1.0)]
    middle += [(3.0, -3.0, 1.5), (0.4, -0.4, -0.2), (-1.0, 0.0, 0.0)]
    found = np.asarray(read(view_along_x(), jnp.asarray(middle, jnp.float32)))
    shares = np.eye(4)[[SURFACE, SURFACE, NEARER, UNKNOWN, BACKGROUND, UNKNOWN]]
    assert found.shape == (6, 6)
    np.testing.assert_allclose(found[:, :4], shares, atol=1e-6)
    np.testing.assert_allclose(found[:, 4], [0.5, -0.5, 1, 0, -1, 0], atol=1e-6)
    # One and two pixels from the surface, but no more than one unit.
    np.testing.assert_allclose(found[:, 5], [0, 0, 1, 1, 0.8, 1], atol=1e-6)


def test_clues_are_continuous_and_have_their_derivative(x64):
    known = jax.tree.map(np.asarray, see(sphere(400), FAR_EYE, "empty"))
    rng = np.random.default_rng(3)
    # Far from the surface, or its depth would be bounded or doubled on the way.
    start, step = rng.uniform(-1, 1, (2, 50, 3))
    path = start + np.linspace(0, 1e-3, 200)[:, None, None] * step
    weights = rng.normal(size=6)

    def total(points):
        found = visibility_features(known, points)
        return (found * weights).sum(), found

    read_and_slope = jax.jit(jax.vmap(jax.value_and_grad(total, has_aux=True)))
    (_, found), gradient = read_and_slope(jnp.asarray(path))
    assert np.abs(np.diff(found, axis=0)).max() < 1e-2
    slope = (gradient[0] * step).sum()
    ends = jnp.asarray([start - 1e-6 * step, start + 1e-6 * step])
    (before, after), _ = read_and_slope(ends)[0]
    np.testing.assert_allclose(slope, (after - before) / 2e-6, rtol=1e-4, atol=1e-4)


def test_points_without_an_image_have_clues_of_nothing():
    points = jnp.asarray([(np.nan, 0, 0), (-5.0, 0, 0), (30.0, 500, 0), (0, 0, 0)])
    known = view_along_x()
    found = np.asarray(read(known, points))[1:]
    np.testing.assert_allclose(found, [[1, 0, 0, 0, 0, 1]] * 3)
    blind = read(nothing_known(8), jnp.asarray(POINTS))
    np.testing.assert_allclose(blind[:, :5], [[1, 0, 0, 0, 0]] * 8)
    depth = jnp.asarray(POINTS)[:, 2]
    aside = jnp.where(depth > 0, jnp.minimum(8 * depth, 1), 1)
    np.testing.assert_allclose(blind[:, 5], aside, rtol=1e-6)
