"""The heading of an upright object, from its partial cloud."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.models.config import ModelConfig
from prism_jax.preprocessing.heading import MAX_POINTS, footprint_angle, level_heading
from prism_jax.preprocessing.observation import observe, workspace_around
from prism_jax.preprocessing.upright import upright
from tests.preprocessing.segmentation.test_support import view_of_box

EYE = np.array([0.5, 4.0, 2.0])


def about_vertical(degrees):
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([(cosine, -sine, 0), (sine, cosine, 0), (0, 0, 1.0)])


@pytest.fixture(scope="module")
def view():
    """Two sides and the top of a cuboid that is longer along x, seen from +y."""
    return view_of_box([3.0, 1.4, 1.0], [0, 0, 0], 900)


def level(points, eye, known=True):
    return level_heading(points, eye, np.array(known), np.ones(len(points), bool))


def test_a_cuboids_angle_is_found(view):
    for degrees in (0, 1, 17, 45, 89):
        found = np.rad2deg(footprint_angle(view @ about_vertical(degrees).T))
        assert abs((found - degrees + 45) % 90 - 45) <= 1.01


@pytest.mark.parametrize("degrees", [0, 80, 200, 320])
def test_any_heading_comes_out_as_one(view, degrees):
    turn = about_vertical(degrees)
    rotation = level(view @ turn.T, turn @ EYE)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation[2], [0, 0, 1], atol=0)
    np.testing.assert_allclose(rotation @ turn, np.eye(3), atol=0.02)
    # Without a sensor the longer side lies along y.
    sides = np.ptp(view @ turn.T @ level(view @ turn.T, EYE, known=False).T, axis=0)
    np.testing.assert_allclose(sides[:2], [1.4, 3.0], atol=0.1)


def test_the_sensor_comes_to_stand_in_front(view):
    for bearing in range(0, 360, 10):
        eye = about_vertical(bearing) @ [0, 4, 1]
        turned = level(view, eye) @ (eye - (view.min(0) + view.max(0)) / 2)
        assert turned[1] > 0 and abs(turned[0]) <= turned[1] + 1e-9


def test_what_does_not_count_does_not_matter_and_of_many_points_some_decide(view):
    more = np.concatenate([view, [[50.0, 3.0, 0.0], [0.0, 80.0, 0.0]]])
    where = np.arange(len(more)) < len(view)
    found = level_heading(more, EYE, np.array(True), where)
    np.testing.assert_allclose(found, np.eye(3), atol=0.02)
    large = np.repeat(view, 3, axis=0)
    assert len(large) > MAX_POINTS
    np.testing.assert_array_equal(level(large, EYE), level(large[::3], EYE))


def test_without_a_footprint_it_is_still_a_turn():
    line = np.linspace(0, 1, 40)[:, None] * [0, 0, 1.0]
    for points in (np.zeros((1, 3)), np.ones((50, 3)), line):
        rotation = level(points, EYE)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_jit_and_vmap_agree_with_numpy_and_gradients_pass_through(view):
    turns = [about_vertical(degrees) for degrees in (5, 100, 200)]
    clouds = np.stack([view @ turn.T for turn in turns])
    eyes = np.stack([turn @ EYE for turn in turns])

    def loss(points, eye):
        partial = observe(points, eye, ModelConfig(heading="level")).partial
        return (partial**2).sum(), partial

    mapped = jax.jit(jax.vmap(jax.grad(loss, has_aux=True)))
    given = jnp.asarray(clouds, jnp.float32), jnp.asarray(eyes, jnp.float32)
    gradient, found = mapped(*given)
    for i in range(3):
        wanted = observe(clouds[i], eyes[i], ModelConfig(heading="level")).partial
        np.testing.assert_allclose(found[i], wanted, atol=1e-5)
    assert jnp.isfinite(gradient).all() and (gradient != 0).any()


@pytest.mark.parametrize("up", ["z", "-y"])
def test_the_workspace_is_upright_and_level(view, up):
    to_z = np.eye(3) if up == "z" else upright(up)
    # Far from the origin, in double precision.
    points = view @ about_vertical(25).T @ to_z + 1e5
    eye = EYE @ about_vertical(25).T @ to_z + 1e5
    workspace = workspace_around(points, eye, 1.4, up, "level")
    unit = workspace.to_unit(points)
    np.testing.assert_allclose(
        unit * 2.1, view - (view.max(0) + view.min(0)) / 2, atol=0.05
    )
    np.testing.assert_allclose(workspace.from_unit(unit), points, atol=1e-9)
