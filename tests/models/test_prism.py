"""A frame, its prediction and its branches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.render import render_depth
from prism_jax.losses.denoise import perturb, upsample_midpoints
from prism_jax.models.encoder import encoder_indices
from prism_jax.models.prism import branches, predict, prepare_input, read_depth

KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def partial(tiny_frames):
    return tiny_frames[0][0]


@pytest.fixture(scope="module")
def camera(tiny_frames):
    return jax.tree.map(lambda leaf: leaf[0], tiny_frames[1])


@pytest.fixture(scope="module")
def prepare(minimal):
    return jax.jit(
        lambda partial, camera: prepare_input(partial, camera, KEY, minimal.model)
    )


@pytest.fixture(scope="module")
def frame(prepare, partial, camera):
    return prepare(partial, camera)


@pytest.fixture(scope="module")
def run(minimal, quick_jit):
    """The whole network on one frame, compiled once."""

    @quick_jit
    def run(variables, frame):
        prediction = predict(variables, frame, minimal.model)
        depth = read_depth(variables, frame, minimal.model)
        seen = branches(variables, frame, prediction, depth, minimal.model)
        return prediction, depth, seen

    return run


@pytest.fixture(scope="module")
def outputs(run, minimal_fresh, frame):
    return run(minimal_fresh, frame)


def test_depth_is_relative_to_the_workspace_and_zero_where_nothing_is(
    frame, partial, camera
):
    depth, mask = render_depth(partial, camera.resized(32, 32))
    distance = camera.translation[2]
    assert np.array_equal(frame.depth_mask, mask)
    assert 5 < mask.sum() < mask.size
    seen = np.asarray(mask)
    expected = np.asarray(depth)[seen] - distance
    np.testing.assert_allclose(np.asarray(frame.depth)[seen], expected, atol=1e-5)
    assert np.abs(expected).max() < np.sqrt(3)
    assert (np.asarray(frame.depth)[~seen] == 0).all()


def test_reference_is_the_partial_at_the_resolution_of_the_losses(
    frame, partial, camera
):
    assert (frame.view.height, frame.view.width) == (16, 16)
    depth, mask = render_depth(partial, camera.resized(16, 16))
    assert np.array_equal(frame.reference_mask, mask)
    np.testing.assert_allclose(frame.reference, depth, atol=1e-6)


def test_what_the_denoiser_gets(frame, partial, camera):
    expected = jax.jit(perturb)(KEY, partial, camera.position)
    np.testing.assert_allclose(frame.perturbed, expected, atol=1e-6)
    np.testing.assert_allclose(frame.upsampled, upsample_midpoints(partial), atol=1e-6)
    apart = np.linalg.norm(frame.perturbed[:, None] - frame.perturbed[None], axis=-1)
    found = np.take_along_axis(apart, np.asarray(frame.perturbed_neighbors), axis=1)
    nearest = np.sort(apart, axis=1)[:, : found.shape[1]]
    np.testing.assert_allclose(found, nearest, atol=1e-6)


def test_indices_are_the_encoders(frame, partial, minimal):
    expected = jax.jit(lambda p: encoder_indices(p, minimal.model.backbone))(partial)
    for a, b in zip(
        jax.tree.leaves(frame.indices), jax.tree.leaves(expected), strict=True
    ):
        assert np.array_equal(a, b)


def test_a_frame_carries_no_gradient_of_the_partial(minimal, partial, camera):
    def total(partial):
        frame = prepare_input(partial, camera, KEY, minimal.model)
        leaves = jax.tree.leaves(frame._replace(view=None))
        return sum(x.sum() for x in leaves if jnp.issubdtype(x.dtype, jnp.floating))

    assert np.array_equal(jax.jit(jax.grad(total))(partial), np.zeros((64, 3)))


def test_an_empty_view_is_finite(prepare, run, minimal_fresh, partial, camera):
    """The camera looks away from everything."""
    behind = dataclasses.replace(camera, translation=-camera.translation)
    frame = prepare(partial, behind)
    assert not frame.depth_mask.any()
    assert not frame.reference_mask.any()
    outputs = run(minimal_fresh, frame)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(outputs))


def test_stages_have_the_configured_sizes(outputs, minimal):
    prediction, _, _ = outputs
    sizes = tuple(len(stage) for stage in prediction.stages)
    assert sizes == minimal.model.backbone.stage_sizes
    assert prediction.points.shape == prediction.stages[-1].shape
    assert prediction.features.shape == (sizes[-1], minimal.model.backbone.features)


def test_prediction_is_the_last_stage_refined_within_bounds(
    outputs, run, minimal, minimal_fresh, frame
):
    """Eq. 2: at first the last stage itself, kept in the workspace."""
    fresh, _, _ = outputs
    inside = np.clip(fresh.stages[-1], -1, 1)
    assert np.array_equal(fresh.points, inside)
    trained = jax.tree.map(lambda x: x + 0.3, minimal_fresh["params"]["refiner"])
    params = {**minimal_fresh["params"], "refiner": trained}
    prediction, _, _ = run({**minimal_fresh, "params": params}, frame)
    points = np.asarray(prediction.points)
    assert np.abs(points).max() <= 1.0
    assert np.abs(points - inside).max() <= minimal.model.auxiliary.max_offset + 1e-7
    assert not np.array_equal(points, inside)


def test_branches(outputs, minimal):
    prediction, depth, seen = outputs
    sizes = minimal.model.auxiliary
    assert seen.normals.shape == prediction.points.shape
    np.testing.assert_allclose(np.linalg.norm(seen.normals, axis=-1), 1, atol=1e-3)
    assert seen.offsets.shape == (64, 3)
    assert seen.tokens_3d.shape == (sizes.num_tokens, sizes.token_features)
    assert seen.tokens_depth.shape == (len(depth.tokens), sizes.token_features)


def test_each_encoder_feeds_its_own_stream(outputs, run, minimal_fresh, frame):
    def moved(name):
        params = dict(minimal_fresh["params"])
        params[name] = jax.tree.map(lambda leaf: 1.1 * leaf, params[name])
        return run({**minimal_fresh, "params": params}, frame)

    prediction, _, seen = outputs
    by_depth = moved("depth_encoder")
    assert np.array_equal(by_depth[0].points, prediction.points)
    assert np.array_equal(by_depth[2].tokens_3d, seen.tokens_3d)
    assert not np.allclose(by_depth[2].tokens_depth, seen.tokens_depth)
    by_points = moved("point_encoder")
    assert not np.allclose(by_points[0].points, prediction.points)
    assert not np.allclose(by_points[2].tokens_3d, seen.tokens_3d)
    assert not np.allclose(by_points[2].offsets, seen.offsets)
    assert np.array_equal(by_points[2].tokens_depth, seen.tokens_depth)
