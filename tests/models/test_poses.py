"""A frame in several poses, completed in each and laid together."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.test_time import make_adapt
from prism_jax.geometry.visibility import look_up, seen_by
from prism_jax.models.config import MAX_POSES, BackboneConfig, ModelConfig
from prism_jax.models.poses import POSES, seen_in
from prism_jax.models.prism import predict, prepare_input


def posed_config(minimal, count, **adapt):
    """That of `minimal`, in so many poses."""
    config = minimal.config.with_adapt(**adapt)
    model = dataclasses.replace(config.model, poses=count)
    return dataclasses.replace(config, model=model)


@pytest.fixture(scope="module")
def frame(tiny_frames):
    return jax.tree.map(lambda leaf: leaf[0], tiny_frames)


@pytest.fixture(scope="module")
def complete(minimal, quick_jit):
    """Completion in all poses, compiled once."""
    return quick_jit(make_adapt(posed_config(minimal, MAX_POSES, num_steps=0)))


def test_they_are_rotations_and_a_mirror_image():
    assert len(POSES) == MAX_POSES
    for pose in POSES:
        np.testing.assert_array_equal(pose @ pose.T, np.eye(3))
        np.testing.assert_array_equal(pose[2], [0, 0, 1])
    np.testing.assert_array_equal(np.linalg.det(POSES) > 0, [True, False, True])
    assert len(np.unique(POSES, axis=0)) == MAX_POSES


def test_the_map_says_of_posed_points_what_it_said(frame):
    """Against the map as it was, of points all about the workspace; the cloud's own
    where none is given."""
    partial, camera = frame
    reads = BackboneConfig(reads_visibility=True)
    config = ModelConfig(reads, background="empty")
    eye = jnp.asarray(camera.position)
    known = seen_by(jnp.asarray(partial), eye, "empty")
    rng = np.random.default_rng(0)
    points = jnp.float32(rng.uniform(-1, 1, (2000, 3)))
    looked_up = jax.jit(look_up)
    state, behind = looked_up(known, points)
    for given, share in ((known, 0.99), (None, 0.9)):
        for pose in POSES:
            cloud, place = jnp.asarray(partial) @ pose.T, pose @ eye
            found = seen_in(pose, cloud, place, given, config)
            assert found is not None
            again, depth = looked_up(found, points @ pose.T)
            # Points on the border of two pixels may fall on either side.
            same = np.asarray(state == again)
            assert same.mean() > share
            if given is not None:
                np.testing.assert_allclose(depth[same], behind[same], atol=1e-4)
    assert seen_in(POSES[1], partial, eye, known, ModelConfig()) is None


def test_each_is_the_completion_of_that_pose(
    minimal, minimal_fresh, frame, complete, quick_jit
):
    """Against the network on a cloud that lies so, brought back."""
    partial, camera = frame
    size = minimal.model.backbone.stage_sizes[-1]
    done = complete(minimal_fresh, partial, camera)
    points = done.points
    assert points.shape == (MAX_POSES * size, 3)

    @quick_jit
    def alone(cloud):
        inputs = prepare_input(cloud, camera, jax.random.key(0), minimal.model)
        found = predict(minimal_fresh, inputs, minimal.model)
        return found.points, found.encoded.global_feature

    for i, pose in enumerate(POSES):
        expected, feature = alone(partial @ pose.T)
        found = points[i * size : (i + 1) * size]
        np.testing.assert_allclose(found, expected @ pose, atol=1e-5)
        if i == 0:
            np.testing.assert_allclose(done.features, feature, atol=1e-5)
    assert np.abs(points[2 * size : 3 * size] - points[:size]).max() > 1e-3


@pytest.mark.slow
def test_adapted_with_all_poses(minimal, minimal_fresh, frame, quick_jit):
    """The first part is that of one pose, and the others move with its encoders."""
    size = minimal.model.backbone.stage_sizes[-1]
    done = {
        count: quick_jit(make_adapt(posed_config(minimal, count, num_steps=1)))(
            minimal_fresh, *frame
        )
        for count in (1, 2)
    }
    for points, own in zip(done[2][:2], done[1][:2], strict=True):
        assert points.shape == (2 * size, 3)
        np.testing.assert_allclose(points[:size], own, atol=1e-5)
    np.testing.assert_allclose(
        done[2].losses.objective, done[1].losses.objective, rtol=1e-4
    )
    assert done[1].accepted and done[2].accepted
    moved = np.abs(done[2].points - done[2].before).max(axis=1)
    assert moved[:size].max() > 1e-6 and moved[size:].max() > 1e-6


@pytest.mark.slow
def test_gradients_of_all_poses(minimal, minimal_variables, frame, quick_jit):
    """Each pose's points have one in the variables, and none reaches the cloud."""
    config = posed_config(minimal, 2, num_steps=0)
    size = minimal.model.backbone.stage_sizes[-1]
    adapt = make_adapt(config)

    @quick_jit
    def gradients(variables, partial, camera):
        def other(variables, partial):
            return (adapt(variables, partial, camera).points[size:] ** 2).mean()

        return jax.grad(other, argnums=(0, 1))(variables, partial)

    variables, cloud = gradients(minimal_variables, *frame)
    leaves = jax.tree.leaves(variables["params"]["point_encoder"])
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert max(np.abs(leaf).max() for leaf in leaves) > 0
    np.testing.assert_array_equal(cloud, 0)


def test_clouds_that_are_hardly_any(minimal_fresh, frame, complete):
    partial, camera = frame
    same = jnp.broadcast_to(partial[:1], partial.shape)
    assert np.isfinite(complete(minimal_fresh, same, camera).points).all()


@pytest.mark.slow
def test_vmap_is_a_loop(minimal_fresh, tiny_frames, frame, complete):
    points = jax.vmap(complete, (None, 0, 0))(minimal_fresh, *tiny_frames).points
    alone = complete(minimal_fresh, *frame).points
    np.testing.assert_allclose(points[0], alone, atol=1e-4)


@pytest.mark.parametrize("count", [0, MAX_POSES + 1])
def test_how_many_there_can_be(count):
    with pytest.raises(ValueError, match="poses"):
        ModelConfig(poses=count)
