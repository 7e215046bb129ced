"""A frame, its prediction and its branches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.render import render_depth
from prism_jax.losses.denoise import perturb, upsample_midpoints
from prism_jax.models.prism import branches, predict, prepare_input, read_depth

KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def prepare(minimal):
    return jax.jit(lambda *frame: prepare_input(*frame, KEY, minimal.model))


@pytest.fixture(scope="module")
def inputs(prepare, frame):
    return prepare(*frame)


@pytest.fixture(scope="module")
def run(minimal, quick_jit):
    """The whole network on one frame, compiled once."""

    @quick_jit
    def run(variables, inputs):
        prediction = predict(variables, inputs, minimal.model)
        depth = read_depth(variables, inputs, minimal.model)
        seen = branches(variables, inputs, prediction, depth, minimal.model)
        return prediction, depth, seen

    return run


@pytest.fixture(scope="module")
def outputs(run, minimal_fresh, inputs):
    return run(minimal_fresh, inputs)


def test_what_a_frame_says_of_its_partial(inputs, frame):
    @jax.jit
    def expected(partial, camera):
        maps = (render_depth(partial, camera.resized(n, n)) for n in (32, 16))
        perturbed = perturb(KEY, partial, camera.position)
        return *maps, perturbed, upsample_midpoints(partial)

    read, (reference, shown), perturbed, upsampled = expected(*frame)
    # Depth is relative to the workspace, and zero where nothing is.
    depth, mask = map(np.asarray, read)
    assert np.array_equal(inputs.depth_mask, mask)
    assert 5 < mask.sum() < mask.size
    relative = np.where(mask, depth - frame[1].translation[2], 0.0)
    np.testing.assert_allclose(inputs.depth, relative, atol=1e-5)
    assert np.array_equal(inputs.reference_mask, shown)
    np.testing.assert_allclose(inputs.reference, reference, atol=1e-6)
    np.testing.assert_allclose(inputs.perturbed, perturbed, atol=1e-6)
    np.testing.assert_allclose(inputs.upsampled, upsampled, atol=1e-6)
    cloud = np.asarray(inputs.perturbed)
    apart = np.linalg.norm(cloud[:, None] - cloud, axis=-1)
    found = np.take_along_axis(apart, np.asarray(inputs.perturbed_neighbors), axis=1)
    nearest = np.sort(apart, axis=1)[:, : found.shape[1]]
    np.testing.assert_allclose(found, nearest, atol=1e-6)


def test_a_frame_carries_no_gradient_of_the_partial(prepare, frame):
    def total(partial):
        leaves = jax.tree.leaves(prepare(partial, frame[1])._replace(view=None))
        return sum(x.sum() for x in leaves if jnp.issubdtype(x.dtype, jnp.floating))

    assert np.array_equal(jax.jit(jax.grad(total))(frame[0]), np.zeros((64, 3)))


def test_an_empty_view_is_finite(prepare, run, minimal_fresh, frame):
    """The camera looks away from everything."""
    partial, camera = frame
    behind = dataclasses.replace(camera, translation=-camera.translation)
    inputs = prepare(partial, behind)
    assert not inputs.depth_mask.any() and not inputs.reference_mask.any()
    outputs = run(minimal_fresh, inputs)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(outputs))


def test_prediction_is_the_last_stage_refined_within_bounds(
    outputs, run, minimal, minimal_fresh, inputs
):
    """Eq. 2: at first the last stage itself, kept in the workspace."""
    fresh, _, _ = outputs
    inside = np.clip(fresh.stages[-1], -1, 1)
    assert np.array_equal(fresh.points, inside)
    refiner = minimal_fresh["params"]["refiner"]
    trained = jax.tree.map(lambda x: np.asarray(x) + np.float32(0.3), refiner)
    params = {**minimal_fresh["params"], "refiner": trained}
    points = np.asarray(run({**minimal_fresh, "params": params}, inputs)[0].points)
    assert np.abs(points).max() <= 1.0
    assert np.abs(points - inside).max() <= minimal.model.auxiliary.max_offset + 1e-7
    assert not np.array_equal(points, inside)


def test_each_encoder_feeds_its_own_stream(outputs, run, minimal_fresh, inputs):
    def moved(name):
        params = dict(minimal_fresh["params"])
        by = np.float32(1.1)
        params[name] = jax.tree.map(lambda leaf: by * np.asarray(leaf), params[name])
        return run({**minimal_fresh, "params": params}, inputs)

    prediction, _, found = outputs
    by_depth = moved("depth_encoder")
    assert np.array_equal(by_depth[0].points, prediction.points)
    assert np.array_equal(by_depth[2].tokens_3d, found.tokens_3d)
    assert not np.allclose(by_depth[2].tokens_depth, found.tokens_depth)
    by_points = moved("point_encoder")
    assert not np.allclose(by_points[0].points, prediction.points)
    assert not np.allclose(by_points[2].tokens_3d, found.tokens_3d)
    assert not np.allclose(by_points[2].offsets, found.offsets)
    assert np.array_equal(by_points[2].tokens_depth, found.tokens_depth)
