"""The depth stream."""

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from prism_jax.geometry.camera import Camera
from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.depth_encoder import DepthEncoder, DepthView, aligned

CONFIG = AuxiliaryConfig(depth_features=(4, 8), depth_blocks=2)
RNG = np.random.default_rng(0)
DEPTH = jnp.asarray(RNG.normal(size=(32, 32)), jnp.float32)
MASK = jnp.asarray(RNG.random((32, 32)) < 0.4)

encode = jax.jit(DepthEncoder(CONFIG).apply)


@pytest.fixture(scope="module")
def variables():
    return jax.jit(DepthEncoder(CONFIG).init)(jax.random.key(0), DEPTH, MASK)


@pytest.mark.parametrize("elsewhere", [5.0, np.nan, np.inf])
def test_depth_outside_the_mask_has_no_influence(variables, elsewhere):
    expected = encode(variables, DEPTH, MASK)
    changed = encode(variables, jnp.where(MASK, DEPTH, elsewhere), MASK)
    for a, b in zip(*map(jax.tree.leaves, (changed, expected)), strict=True):
        assert np.array_equal(a, b)


def test_nor_has_it_a_gradient_there(variables):
    def loss(depth):
        return (encode(variables, depth, MASK).tokens ** 2).sum()

    gradient = np.asarray(jax.jit(jax.grad(loss))(DEPTH))
    assert np.isfinite(gradient).all()
    assert (gradient[~np.asarray(MASK)] == 0).all()
    assert (gradient[np.asarray(MASK)] != 0).any()


def test_depth_and_mask_both_count(variables):
    tokens = encode(variables, DEPTH, MASK).tokens
    assert not np.allclose(encode(variables, DEPTH + 1, MASK).tokens, tokens)
    zero = jnp.zeros_like(DEPTH)
    here, nowhere = encode(variables, zero, MASK), encode(variables, zero, ~MASK)
    assert not np.allclose(here.tokens, nowhere.tokens)


def test_tokens_are_the_cells_of_the_last_map(variables):
    features = encode(variables, DEPTH, MASK)
    # 32 pixels halved by stem, pooling and the second stage.
    assert features.tokens.shape == (4 * 4, 8)
    np.testing.assert_allclose(features.pooled, features.tokens.mean(0), rtol=1e-6)


def test_an_empty_view_is_finite(variables):
    features = encode(variables, DEPTH, jnp.zeros_like(MASK))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(features))


VIEW = DepthView(
    Camera.fixed_view().resized(32, 32),
    tuple(jnp.asarray(RNG.normal(size=(n, n, n)), jnp.float32) for n in (8, 4)),
)
"""Two maps of other sizes than the camera's own."""


def inside(count):
    """Points of the workspace, all of which the camera sees."""
    return RNG.uniform(-0.5, 0.5, (count, 3)).astype(np.float32)


def test_features_at_points_are_scipys_interpolation():
    """Beside the image there is nothing, nor behind the camera."""
    eye = np.asarray(VIEW.camera.position)
    beside = 0.5 * eye + 3.0 * RNG.normal(size=(20, 3))
    points = np.concatenate([inside(50), beside, [2.0 * eye]]).astype(np.float32)
    found = jax.jit(lambda points: aligned(VIEW, points))(points)
    expected = []
    for image in VIEW.maps:
        uv, z = VIEW.camera.resized(*image.shape[:2]).project(points)
        place = np.asarray(uv)[:, ::-1].T
        read = [
            map_coordinates(channel, place, order=1, mode="grid-constant")
            for channel in np.moveaxis(image, -1, 0)
        ]
        expected.append(np.where(np.asarray(z) > 0, read, 0.0))
    expected = np.concatenate(expected).T
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert (expected[:50] != 0).all() and (expected[-1] == 0).all()
    assert aligned(VIEW, jnp.asarray(points[:1])).shape == (1, 12)
    mapped = jax.jit(lambda clouds: jax.vmap(aligned, (None, 0))(VIEW, clouds))
    several = mapped(points[:70].reshape(7, 10, 3))
    np.testing.assert_allclose(several.reshape(70, 12), found[:70], atol=1e-5)


def test_features_at_points_have_their_derivatives(x64):
    """In the points and in the maps."""
    points, weights = jnp.asarray(inside(30), float), RNG.normal(size=12)
    step, other = RNG.normal(size=points.shape), RNG.normal(size=VIEW.maps[1].shape)

    @jax.jit
    def total(points, coarse):
        return (
            aligned(VIEW._replace(maps=(VIEW.maps[0], coarse)), points) @ weights
        ).sum()

    def along(t):
        return total(points + t * step, VIEW.maps[1] + t * other)

    slope = jax.jvp(along, (0.0,), (1.0,))[1]
    by_steps = (along(1e-7) - along(-1e-7)) / 2e-7
    np.testing.assert_allclose(slope, by_steps, rtol=1e-5)
    gradients = jax.grad(total, argnums=(0, 1))(points, VIEW.maps[1])
    backwards = (gradients[0] * step).sum() + (gradients[1] * other).sum()
    np.testing.assert_allclose(backwards, slope, rtol=1e-5)


def test_statistics_move_in_training_alone(variables):
    module = DepthEncoder(CONFIG)
    batch = jnp.stack([DEPTH, 2 * DEPTH]), jnp.stack([MASK, MASK])
    train = jax.jit(lambda v: module.apply(v, *batch, True, mutable=["batch_stats"]))
    _, updated = train(variables)
    before = jax.tree.leaves(variables["batch_stats"])
    after = jax.tree.leaves(updated["batch_stats"])
    assert all(not np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    with pytest.raises(flax.errors.ModifyScopeVariableError):
        module.apply(variables, *batch, True)


def test_mapped_over_frames_it_is_the_loop(variables):
    depths = jnp.stack([DEPTH, DEPTH.T, -DEPTH])
    masks = jnp.stack([MASK, MASK.T, ~MASK])
    together = jax.jit(jax.vmap(encode, (None, 0, 0)))(variables, depths, masks)
    batched = encode(variables, depths, masks)
    for i in range(3):
        alone = encode(variables, depths[i], masks[i])
        np.testing.assert_allclose(together.tokens[i], alone.tokens, atol=1e-5)
        np.testing.assert_allclose(batched.tokens[i], alone.tokens, atol=1e-5)
