"""Losses of what a view knows: scipy's distances, closed forms, finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, map_coordinates, minimum_filter
from scipy.spatial import KDTree

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import (
    BACKGROUND,
    NEARER,
    SURFACE,
    UNKNOWN,
    Visibility,
    beside,
    free_depth,
    nothing_known,
)
from prism_jax.losses.visibility import contradiction, keep_loss, visibility_loss

SIZE, FOCAL, MIDDLE = 24, 20.0, 11.5
# Looks along +z from z = -3, image rows along +y: the depth of a point is z + 3.
CAMERA = Camera(
    rotation=jnp.eye(3),
    translation=jnp.asarray([0.0, 0.0, 3.0]),
    intrinsics=jnp.asarray([[FOCAL, 0, MIDDLE], [0, FOCAL, MIDDLE], [0, 0, 1.0]]),
    height=SIZE,
    width=SIZE,
)
DEPTHS = {UNKNOWN: 0.0, SURFACE: 2.8, NEARER: 1.5, BACKGROUND: 9.0}
TOLERANCE = 0.2


def scene() -> Visibility:
    """A disk, a bar before its lower part, a strip that nobody knows, and a wall."""
    rows, columns = np.indices((SIZE, SIZE)) - MIDDLE
    state = np.full((SIZE, SIZE), BACKGROUND, np.uint8)
    state[np.hypot(rows, columns) < 6] = SURFACE
    state[rows > 4] = NEARER
    state[:, :4] = UNKNOWN
    depth = np.vectorize(DEPTHS.get)(state).astype(np.float32)
    return Visibility(CAMERA, state, depth)


def at(row, column, depth):
    """The point whose image is there."""
    depth = np.asarray(depth)
    x, y = (depth * (np.asarray(c) - MIDDLE) / FOCAL for c in (column, row))
    return np.stack(np.broadcast_arrays(x, y, depth - 3.0), -1).astype(np.float32)


losses = jax.jit(contradiction)
mean_loss = jax.jit(visibility_loss)
keep = jax.jit(keep_loss)


def test_ways_out_of_free_space_in_closed_form():
    points = np.concatenate(
        [
            at(11, 12, [2.8, 2.5, 2.9, 6.0]),  # on, before and behind the disk
            at(20, 12, [1.0, 2.8]),  # before the bar and hidden by it
            at(12, 1, [1.0, 2.8]),  # where nobody knows
            at(11.5, 20, [2.0, 8.7]),  # beside the disk, far from the wall and by it
            at(11.5, 20, [8.9, 10.0]),  # by the wall, and behind it
            at(11.5, 18, [2.5, 8.0]),  # near the disk, before and behind it
        ]
    )
    # The disk ends half a pixel after the last one within a radius of six.
    aside = 20 - (MIDDLE + 5.5) - 0.5
    expected = [0, 0.1, 0, 0, 0.3, 0, 0, 0, aside * 2.0 / FOCAL, 0.1, 0, 0]
    expected += [min(0.5 * 2.5 / FOCAL, 0.1), 0]
    found = losses(jnp.asarray(points), scene(), TOLERANCE)
    np.testing.assert_allclose(np.sqrt(found), expected, atol=1e-5)
    mean = mean_loss(jnp.asarray(points), scene(), TOLERANCE)
    np.testing.assert_allclose(mean, np.square(expected).mean(), rtol=1e-5)


def test_the_way_aside_is_scipys():
    """Its distance transform, and its interpolation between the middles of pixels."""
    known = scene()
    rng = np.random.default_rng(0)
    row, column = rng.uniform(0, SIZE - 1, (2, 400))
    depth = rng.uniform(1, 4, 400)
    apart = distance_transform_edt(known.state != SURFACE)
    pixels = map_coordinates(apart, [row, column], order=1)
    expected = np.maximum(pixels - 0.5, 0) * depth / FOCAL
    points = jnp.asarray(at(row, column, depth))
    np.testing.assert_allclose(beside(known, points), expected, atol=1e-5)
    found = losses(points, known, TOLERANCE)
    state = known.state[np.rint(row).astype(int), np.rint(column).astype(int)]
    measured = free_depth(known)[row.round().astype(int), column.round().astype(int)]
    way = np.where(state == UNKNOWN, 0, np.maximum(measured - depth - TOLERANCE, 0))
    before = state == BACKGROUND
    way[before] = np.minimum(way, expected)[before]
    assert min((way > 0)[before].sum(), (way > 0)[~before].sum()) > 10
    np.testing.assert_allclose(np.sqrt(found), way, atol=1e-5)


def test_what_is_free_is_so_all_about_a_pixel():
    """Scipy's minimum over five by five pixels; what is unknown hides nothing."""
    known = scene()
    measured = np.where(known.state == UNKNOWN, np.inf, known.depth)
    expected = minimum_filter(measured, 5, mode="constant", cval=np.inf)
    expected = np.where(known.state == UNKNOWN, 0, expected)
    assert len(np.unique(expected)) == 4
    np.testing.assert_array_equal(jax.jit(free_depth)(known), expected)
    several = jax.tree.map(lambda leaf: np.stack([leaf] * 2), known)
    np.testing.assert_array_equal(jax.vmap(free_depth)(several)[1], expected)


def test_gradient_against_finite_differences(x64):
    known = scene()
    rng = np.random.default_rng(1)
    row, column = rng.uniform(0, SIZE - 1, (2, 200))
    points = jnp.asarray(at(row, column, rng.uniform(1, 4, 200)), float)
    along = jnp.asarray(rng.normal(size=points.shape))
    gradient = jax.grad(mean_loss)(points, known, TOLERANCE)
    step = 1e-7
    both = [mean_loss(points + s * step * along, known, TOLERANCE) for s in (1, -1)]
    slope = (gradient * along).sum()
    assert abs(slope) > 1e-3
    np.testing.assert_allclose((both[0] - both[1]) / (2 * step), slope, rtol=1e-4)


def test_descending_brings_points_back_to_the_outline():
    known = scene()
    points = jnp.asarray(at(np.linspace(1, 12, 40), 21, 2.8))

    @jax.jit
    def step(points):
        return points - 0.1 * len(points) * jax.grad(visibility_loss)(
            points, known, 0.2
        )

    assert losses(points, known, 0.2).min() > 0.1
    for _ in range(40):
        points = step(points)
    assert losses(points, known, 0.2).max() < 1e-3


def test_what_is_unknown_costs_nothing_and_has_no_gradient():
    """Nor has what lies beside the image, behind the camera, or is not finite."""
    free = at(11.5, 20, 2.0)
    points = np.stack(
        [free, at(12, 1, 1.0), at(12, 90, 1.0), (0, 0, -5), (np.nan, 0, 0), free]
    )
    points[-1, 2] = np.inf
    grad = jax.value_and_grad(mean_loss)
    value, gradient = grad(jnp.asarray(points, jnp.float32), scene(), TOLERANCE)
    expected = losses(jnp.asarray(free)[None], scene(), TOLERANCE)[0] / 6
    np.testing.assert_allclose(value, expected, rtol=1e-6)
    assert np.isfinite(gradient).all() and np.abs(gradient[0]).max() > 0
    assert (gradient[1:] == 0).all()
    value, gradient = grad(jnp.asarray(points[:4]), nothing_known(8), TOLERANCE)
    assert value == 0 and (gradient == 0).all()


@pytest.mark.parametrize("state", [BACKGROUND, NEARER])
def test_without_any_surface_the_way_is_back_to_what_was_measured(state):
    depth = np.full((SIZE, SIZE), 4.0, np.float32)
    known = Visibility(CAMERA, np.full((SIZE, SIZE), state, np.uint8), depth)
    points = jnp.asarray(at(np.array([2.0, 20.0]), 11.5, np.array([3.0, 4.5])))
    value, gradient = jax.value_and_grad(mean_loss)(points, known, TOLERANCE)
    np.testing.assert_allclose(value, 0.8**2 / 2, rtol=1e-5)
    np.testing.assert_allclose(gradient, [[0, 0, -0.8], [0, 0, 0]], atol=1e-5)


def test_mapped_it_is_the_same():
    known = scene()
    rng = np.random.default_rng(2)
    clouds = jnp.asarray(at(*rng.uniform(0, SIZE - 1, (2, 3, 50)), 2.0))
    several = jax.tree.map(lambda leaf: np.stack([leaf] * 3), known)
    found = jax.jit(jax.vmap(visibility_loss, (0, 0, None)))(clouds, several, 0.1)
    for cloud, value in zip(clouds, found, strict=True):
        np.testing.assert_allclose(value, mean_loss(cloud, known, 0.1), rtol=1e-6)


def cloud(count, seed, dtype=np.float32):
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return jnp.asarray(points, dtype)


def test_what_is_kept_costs_its_distance_to_the_points():
    points, kept = cloud(70, 3), cloud(50, 4)
    mask = jnp.asarray(np.random.default_rng(5).random(50) < 0.6)
    expected = (KDTree(points).query(kept[mask])[0] ** 2).mean()
    found = keep(points, kept, mask)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    moved = kept + jnp.array([0.0, 0.0, 1e-3])
    np.testing.assert_allclose(keep(moved, kept, mask), 1e-6, rtol=1e-2)
    several = jax.vmap(keep)(*(jnp.stack([a, a]) for a in (points, kept, mask)))
    np.testing.assert_allclose(several, expected, rtol=1e-5)


def test_gradient_of_what_is_kept(x64):
    points, kept = (cloud(n, n, np.float64) for n in (30, 40))
    mask = jnp.arange(40) % 3 > 0
    along = cloud(30, 6, np.float64)
    slope = (jax.grad(keep)(points, kept, mask) * along).sum()
    both = [keep(points + s * 1e-6 * along, kept, mask) for s in (1, -1)]
    assert abs(slope) > 1e-3
    np.testing.assert_allclose((both[0] - both[1]) / 2e-6, slope, rtol=1e-6)
    assert (jax.grad(keep, 1)(points, kept, mask) == 0).all()


def test_nothing_to_keep_and_all_of_it_covered():
    points = cloud(20, 7)
    for mask in (jnp.zeros(20, bool), jnp.ones(20, bool)):
        value, gradient = jax.value_and_grad(keep)(points, points, mask)
        assert value == 0 and (gradient == 0).all()
    with pytest.raises(ValueError):
        keep_loss(points[:0], points, mask)
