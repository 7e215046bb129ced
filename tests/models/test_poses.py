"""A frame in several poses, completed in each and laid together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.test_time import make_adapt
from prism_jax.geometry.visibility import look_up, seen_by
from prism_jax.models.config import MAX_POSES, BackboneConfig, ModelConfig
from prism_jax.models.poses import POSES, seen_in
from prism_jax.models.variables import pop_encoders
from tests.trees import bitwise


def test_they_are_rotations_and_a_mirror_image():
    assert len(POSES) == MAX_POSES
    for pose in POSES:
        np.testing.assert_array_equal(pose @ pose.T, np.eye(3))
        np.testing.assert_array_equal(pose[2], [0, 0, 1])
    np.testing.assert_array_equal(np.linalg.det(POSES) > 0, [True, False, True])
    assert len(np.unique(POSES, axis=0)) == MAX_POSES


def test_the_map_says_of_posed_points_what_it_said(frame):
    """Where none is given, that of the cloud."""
    partial, camera = frame
    reads = BackboneConfig(reads_visibility=True)
    config = ModelConfig(reads, background="empty")
    eye = jnp.asarray(camera.position)
    rng = np.random.default_rng(0)
    points = jnp.float32(rng.uniform(-1, 1, (2000, 3)))
    cases = [(pose, True, 0.99) for pose in POSES] + [(POSES[1], False, 0.9)]

    @jax.jit
    def look(partial):
        known = seen_by(partial, eye, "empty")
        found = [known]
        for pose, is_given, _ in cases:
            given = known if is_given else None
            found.append(seen_in(pose, partial @ pose.T, pose @ eye, given, config))
        poses = [POSES[0], *(pose for pose, *_ in cases)]
        places = [points @ pose.T for pose in poses]
        return known, [look_up(*pair) for pair in zip(found, places, strict=True)]

    known, [(state, behind), *looks] = look(jnp.asarray(partial))
    for (_, is_given, share), (again, depth) in zip(cases, looks, strict=True):
        # Points on the border of two pixels may fall on either side.
        same = np.asarray(state == again)
        assert same.mean() > share
        if is_given:
            np.testing.assert_allclose(depth[same], behind[same], atol=1e-4)
    assert seen_in(POSES[1], partial, eye, known, ModelConfig()) is None


def test_each_is_the_completion_of_that_pose(minimal, minimal_fresh, frame, quick_jit):
    """Against a cloud that lies so, completed as it is and brought back."""
    config = minimal.config.with_adapt(num_steps=0).with_model(poses=MAX_POSES)
    complete = quick_jit(make_adapt(config))
    partial, camera = frame
    size = minimal.model.backbone.stage_sizes[-1]
    completion = complete(minimal_fresh, partial, camera)
    points = completion.points
    # Without steps nothing is adapted.
    assert not completion.accepted and bitwise(points, completion.before)
    assert bitwise(completion.encoders, pop_encoders(minimal_fresh)[0])
    assert points.shape == (MAX_POSES * size, 3)
    for i, pose in enumerate(POSES):
        alone = complete(minimal_fresh, partial @ pose.T, camera).points[:size]
        found = points[i * size : (i + 1) * size]
        np.testing.assert_allclose(found, alone @ pose, atol=1e-5)
    assert np.abs(points[2 * size :] - points[:size]).max() > 1e-3
    same = jnp.broadcast_to(partial[:1], partial.shape)
    assert np.isfinite(complete(minimal_fresh, same, camera).points).all()


@pytest.mark.slow
def test_adapted_with_all_poses(minimal, minimal_fresh, frame, quick_jit):
    """The first part is that of one pose, and the others move with its encoders."""
    size = minimal.model.backbone.stage_sizes[-1]
    config = minimal.config.with_adapt(num_steps=1)
    one, two = (
        quick_jit(make_adapt(config.with_model(poses=count)))(minimal_fresh, *frame)
        for count in (1, 2)
    )
    for points, own in zip(two[:2], one[:2], strict=True):
        assert points.shape == (2 * size, 3)
        np.testing.assert_allclose(points[:size], own, atol=1e-5)
    np.testing.assert_allclose(two.losses.objective, one.losses.objective, rtol=1e-4)
    assert one.accepted and two.accepted
    moved = np.abs(two.points - two.before).max(axis=1)
    assert moved[:size].max() > 1e-6 and moved[size:].max() > 1e-6
