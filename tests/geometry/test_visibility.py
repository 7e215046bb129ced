"""Visibility: closed forms, points that have no image, mirror images."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.render import render_depth
from prism_jax.geometry.visibility import (
    BACKGROUND,
    NEARER,
    SURFACE,
    UNKNOWN,
    Visibility,
    look_up,
    mirrored,
    nothing_known,
    to_unit,
    turned,
)
from prism_jax.geometry.workspace import Workspace


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


def test_state_and_depth_behind_in_closed_form():
    state, behind = look_up(view_along_x(), POINTS)
    assert isinstance(state, np.ndarray) and isinstance(behind, np.ndarray)
    assert state.dtype == np.uint8 and behind.dtype == np.float32
    np.testing.assert_array_equal(state, STATES)
    np.testing.assert_allclose(behind, BEHIND, atol=1e-6)


def test_jitted_and_mapped_it_is_the_same():
    view = view_along_x()
    for points in (POINTS, jnp.asarray(POINTS)):
        state, behind = jax.jit(look_up)(view, points)
        np.testing.assert_array_equal(state, STATES)
        np.testing.assert_allclose(behind, BEHIND, atol=1e-6)
    moved = dataclasses.replace(
        view.camera, translation=np.array([0, 0, -0.25], np.float32)
    )
    both = jax.tree.map(lambda *rows: np.stack(rows), view, view._replace(camera=moved))
    state, behind = jax.vmap(look_up, (0, None))(both, POINTS)
    assert state.shape == behind.shape == (2, 8)
    np.testing.assert_allclose(behind[0], BEHIND, atol=1e-6)
    np.testing.assert_allclose(behind[1, 2], 1.75, atol=1e-6)


def test_points_that_are_not_finite_are_unknown():
    points = POINTS.copy()
    points[0], points[1] = np.nan, np.inf
    for found in (look_up(view_along_x(), points), look_up(view_along_x(), points[:0])):
        assert np.all(found[0][:2] == UNKNOWN) and np.all(found[1][:2] == 0)
    gradient = jax.grad(lambda x: look_up(view_along_x(), x)[1].sum())
    # Depth is along x here, and the two that are not finite have none.
    expected = [0, 0, 1, 0, 1, 0, 0, 0]
    np.testing.assert_allclose(gradient(jnp.asarray(points))[:, 0], expected, atol=1e-6)


def test_what_is_rendered_is_found_again():
    """The nearest point of each pixel at its depth, all others behind it."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (400, 3)).astype(np.float32)
    camera = Camera.look_at((3.0, 1.0, 0.5), (0, 0, 0), height=16, width=24)
    depth, mask = render_depth(jnp.asarray(points), camera)
    view = Visibility(camera, jnp.where(mask, SURFACE, UNKNOWN).astype("uint8"), depth)
    state, behind = look_up(view, points)
    assert np.all(np.asarray(state) == SURFACE)
    assert behind.min() == 0
    assert np.sum(np.asarray(behind) == 0) == mask.sum() < 300


def test_a_map_that_knows_nothing():
    state, behind = look_up(nothing_known(5), POINTS)
    assert np.all(state == UNKNOWN) and np.all(behind == 0)


@pytest.mark.parametrize("stacked", [False, True])
def test_a_mirror_image_knows_the_same_of_mirrored_points(stacked):
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
    if stacked:
        both = mirrored(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), view))
        image = jax.tree.map(lambda leaf: leaf[1], both)
    else:
        image = mirrored(view)
    np.testing.assert_allclose(np.linalg.det(image.camera.rotation), 1, atol=1e-6)
    state, behind = look_up(image, points * [-1, 1, 1])
    assert np.sum(expected[0] != UNKNOWN) > 100
    np.testing.assert_array_equal(state, expected[0])
    np.testing.assert_allclose(behind, expected[1], atol=1e-5)
    again = jax.tree.leaves(mirrored(image))
    for found, given in zip(again, jax.tree.leaves(view), strict=True):
        np.testing.assert_allclose(found, given, atol=1e-5)


@pytest.mark.parametrize("xp", [np, jnp])
def test_turned_points_and_those_of_a_workspace_are_found_as_before(xp):
    """Depths in the unit of the workspace."""
    rng = np.random.default_rng(2)
    view = jax.tree.map(xp.asarray, view_along_x())
    turn = Rotation.random(rng=rng).as_matrix().astype(np.float32)
    state, behind = look_up(turned(view, turn), xp.asarray(POINTS @ turn))
    np.testing.assert_array_equal(state, STATES)
    np.testing.assert_allclose(behind, BEHIND, atol=1e-5)
    workspace = Workspace(np.array([0.3, 2, -1]), np.array(2.5), turn.astype(float))
    unit = xp.asarray(workspace.to_unit(POINTS).astype(np.float32))
    state, behind = look_up(to_unit(view, workspace), unit)
    np.testing.assert_array_equal(state, STATES)
    np.testing.assert_allclose(behind, np.array(BEHIND) / 2.5, atol=1e-5)
