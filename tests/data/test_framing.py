"""An example in the workspace of its partial."""

import jax
import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation.views import make_views
from prism_jax.data.pipeline import Framing, frame_example, stack
from prism_jax.data.source import Example
from prism_jax.geometry.visibility import BACKGROUND, SURFACE, look_up, nothing_known
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError

FRAMING = Framing(64, 128, 1.4)


def cloud(rng, count):
    return (rng.normal(size=(count, 3)) * [1, 2, 0.5] + [5, 0, -1]).astype(np.float32)


@pytest.fixture(scope="module")
def example():
    """Far from the origin, and not in farthest-point order."""
    rng = np.random.default_rng(0)
    eye = np.array([5, -9, 2], np.float32)
    return Example(cloud(rng, 1000), cloud(rng, 300), eye, "thing", "0")


@pytest.mark.parametrize("ordered", [True, False])
def test_frame_is_the_workspace_of_the_partial(example, ordered):
    """Of all of it, in double precision; the complete cloud has no part in it."""
    workspace = Workspace.from_points(example.partial.astype(np.float64), 1.4)
    given = example._replace(ordered=ordered, complete=3 * example.complete + 99)
    batch = frame_example(given, FRAMING)
    assert {array.dtype for array in batch[:4]} == {np.dtype(np.float32)}
    eye = workspace.to_unit(example.eye.astype(np.float64))
    np.testing.assert_allclose(batch.eye, eye, atol=1e-6)
    clouds = (batch.partial, given.partial, 64), (batch.complete, given.complete, 128)
    for found, original, count in clouds:
        assert found.shape == (count, 3)
        mapped = workspace.to_unit(original.astype(np.float64))
        if ordered:
            np.testing.assert_allclose(found, mapped[:count], rtol=1e-6, atol=1e-6)
        gaps, chosen = KDTree(mapped).query(found)
        assert gaps.max() < 1e-5 and len(set(chosen)) == count
        steps = [KDTree(found[:n]).query(found[n])[0] for n in range(1, count)]
        # In farthest-point order the gaps shrink.
        assert ordered or np.diff(steps).max() <= 1e-6 * np.abs(mapped).max()


def test_the_scale_leads_to_the_unit_of_the_scores(example):
    """There the longest side of the complete cloud has length two."""
    example = example._replace(partial=example.partial / 3)
    batch = frame_example(example, Framing(64, len(example.complete), 1.4))
    scored = batch.complete * batch.scale
    assert np.ptp(scored, axis=0).max() == pytest.approx(2, rel=1e-5)


def test_a_mirror_image_is_that_or_nothing_changes(example):
    before = [np.array(array) for array in example[:3]]
    plain, flip = frame_example(example, FRAMING), np.array([-1, 1, 1], np.float32)
    found = set()
    for seed in range(10):
        batch = frame_example(example, FRAMING, np.random.default_rng(seed))
        sign = 1 if np.array_equal(batch.eye, plain.eye) else flip
        found.add(sign is flip)
        for a, b in zip(batch[:3], plain[:3], strict=True):
            assert np.array_equal(a, b * sign)
        assert batch.scale == plain.scale
    assert found == {True, False}
    assert all(map(np.array_equal, before, example[:3]))


def test_what_may_have_any_heading_is_turned_about_the_vertical(example):
    """In training: the same shape in its workspace, each time in another direction."""
    turning = example._replace(any_heading=True, ordered=True)
    for found, expected in zip(
        frame_example(turning, FRAMING)[:4],
        frame_example(turning._replace(any_heading=False), FRAMING)[:4],
        strict=True,
    ):
        np.testing.assert_array_equal(found, expected)
    angles = []
    for seed in range(8):
        batch = frame_example(turning, FRAMING, np.random.default_rng(seed))
        found = np.concatenate([batch.partial, batch.eye[None]])
        given = np.concatenate([example.partial[:64], example.eye[None]])
        found = found * np.ptp(given[:, 2]) / np.ptp(found[:, 2])
        found, given = (x.astype(np.float64) - x[0] for x in (found, given))
        np.testing.assert_allclose(found[:, 2], given[:, 2], atol=1e-5)
        flat_found, flat_given = (x[1:, :2] @ [1, 1j] for x in (found, given))
        ratio = flat_found / flat_given
        if np.ptp(ratio.real) > 1e-3:
            ratio = -flat_found.conj() / flat_given
        np.testing.assert_allclose(ratio, ratio[0], atol=1e-4)
        np.testing.assert_allclose(abs(ratio), 1, atol=1e-4)
        angles.append(np.angle(ratio[0]))
    assert np.ptp(angles) > 2 and len(np.unique(np.round(angles, 3))) == 8


def test_where_there_is_no_partial_one_is_cropped(example):
    """For a test always the same half; for training another one each time."""
    whole = example._replace(partial=None, ordered=True)
    gaps = np.linalg.norm(whole.complete.astype(np.float64) - 1, axis=1)
    half = whole.complete[gaps >= np.median(gaps)]
    expected = frame_example(whole._replace(partial=half, ordered=False), FRAMING)
    found = frame_example(whole, FRAMING)
    assert all(map(np.array_equal, found[:4], expected[:4]))
    cropped = [
        frame_example(whole, FRAMING, np.random.default_rng(seed)) for seed in range(4)
    ]
    # What a mirror leaves as it is.
    assert len({batch.partial[:, 1:].tobytes() for batch in cropped}) == 4
    with pytest.raises(InputError, match="0: no complete cloud"):
        frame_example(example._replace(complete=None), FRAMING)


def test_a_level_heading_is_found_whatever_the_pose(example):
    """In validation by the example's name; in training at random, tilts and quarter
    turns among them. The clouds stay together, and in the unit of the scores."""
    level = FRAMING._replace(heading="level")
    given = frame_example(example, FRAMING)
    posed = frame_example(example, level)
    np.testing.assert_array_equal(frame_example(example, level).partial, posed.partial)
    other = frame_example(example._replace(name="another"), level)
    assert not np.allclose(other.eye, posed.eye)
    rng = np.random.default_rng(0)
    trained = [frame_example(example, level, rng) for _ in range(12)]
    bearings = [np.arctan2(batch.eye[0], batch.eye[1]) for batch in trained]
    assert max(np.abs(bearings)) > np.pi / 4  # not always in front
    for batch in (posed, other, *trained):
        assert np.abs(batch.partial).max() <= 1 / 1.4 + 1e-6
        for name in ("partial", "complete"):
            was = getattr(given, name) * given.scale
            now = getattr(batch, name) * batch.scale
            spread = [np.linalg.norm(cloud - cloud[0], axis=1) for cloud in (was, now)]
            np.testing.assert_allclose(*spread, rtol=1e-3, atol=1e-4)


@pytest.fixture(scope="module")
def seen():
    """An example that says what its sensor knows."""
    made = make_views("gearbox", 5, 1, "occluded+noisy")
    return Example(
        made.complete,
        made.partials[0],
        made.eyes[0],
        "gearbox",
        "0",
        ordered=True,
        any_heading=True,
        visibility=made.visibilities[0],
    )


@pytest.mark.parametrize("heading", ["given", "level"])
def test_what_the_sensor_knows_goes_with_the_clouds(seen, heading):
    """Mirrored, turned, tilted, by quarters too: the points are on the surface, hardly
    any of the object is where the map says it is free, all as before; the camera stands
    at the eye, and its rotation is one."""
    framing = Framing(256, 512, 1.4, heading)
    before = [look_up(seen.visibility, seen.partial[:256])]
    before.append(look_up(seen.visibility, seen.complete[:512]))
    signs = set()
    for seed in range(12):
        batch = frame_example(seen, framing, np.random.default_rng(seed))
        known = batch.visibility
        np.testing.assert_allclose(known.camera.position, batch.eye, atol=2e-4)
        np.testing.assert_allclose(np.linalg.det(known.camera.rotation), 1, atol=1e-5)
        signs.add(np.sign(np.linalg.det(_way(batch, seen))))
        # In the example's unit, half the longest side of the complete cloud.
        found = [look_up(known, cloud) for cloud in (batch.partial, batch.complete)]
        (state, depth), (_, of_complete) = ((s, d * batch.scale) for s, d in found)
        assert np.mean(of_complete < -0.15) < 0.04
        assert np.mean(state == SURFACE) > 0.99
        assert np.quantile(depth, 0.01) > -1e-3
        for (now, further), (was, depth) in zip(found, before, strict=True):
            same = now == was
            assert np.mean(same) > 0.99
            scaled = (further * batch.scale)[same]
            np.testing.assert_allclose(scaled, depth[same], atol=2e-3)
    assert heading == "level" or signs == {-1.0, 1.0}


def _way(batch, example):
    """The matrix that led from the example's points to the batch's."""
    given = example.complete[:512] - example.complete[:512].mean(axis=0)
    found = batch.complete - batch.complete.mean(axis=0)
    return np.linalg.lstsq(given, found, rcond=None)[0]


def test_a_row_without_a_map_gets_what_its_clouds_say_beside_others(seen):
    """And so does one whose packed map knows nothing, of which none was kept."""
    lost = seen._replace(visibility=nothing_known())
    rows = [frame_example(one, FRAMING) for one in (seen, lost)]
    assert rows[1].visibility is None
    batch = stack(rows)
    assert batch.partial.shape == (2, 64, 3) and batch.scale.shape == (2,)
    np.testing.assert_array_equal(batch.visibility.state[0], rows[0].visibility.state)
    told = batch.visibility._replace(
        camera=jax.tree.map(lambda leaf: leaf[1], batch.visibility.camera),
        state=batch.visibility.state[1],
        depth=batch.visibility.depth[1],
    )
    assert set(np.unique(told.state)) == {SURFACE, BACKGROUND}
    state, behind = look_up(told, batch.partial[1])
    assert np.mean(state == SURFACE) > 0.98 and np.median(np.abs(behind)) < 0.05
    assert stack([rows[1], rows[1]]).visibility is None
