"""An example in the workspace of its partial."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation.views import make_views
from prism_jax.data.augmentation import Augmentation
from prism_jax.data.pipeline import Framing, frame_example, stack
from prism_jax.data.source import Example
from prism_jax.geometry.visibility import SURFACE, look_up, nothing_known, seen_by
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
    """All of it, in double precision."""
    workspace = Workspace.from_points(example.partial.astype(np.float64), 1.4)
    batch = frame_example(example._replace(ordered=ordered), FRAMING)
    assert batch.partial.shape == (64, 3)
    assert batch.complete.shape == (128, 3)
    assert {array.dtype for array in batch[:4]} == {np.dtype(np.float32)}
    eye = workspace.to_unit(example.eye.astype(np.float64))
    np.testing.assert_allclose(batch.eye, eye, atol=1e-6)
    for found, original in [
        (batch.partial, example.partial),
        (batch.complete, example.complete),
    ]:
        mapped = workspace.to_unit(original.astype(np.float64))
        if ordered:
            np.testing.assert_allclose(found, mapped[: len(found)], atol=1e-6)
        gaps, chosen = KDTree(mapped).query(found)
        assert gaps.max() < 1e-6
        assert len(set(chosen)) == len(found)


def test_clouds_in_no_order_are_put_into_farthest_point_order(example):
    """Distances to the nearest of all points before shrink."""
    batch = frame_example(example, FRAMING)
    for points in (batch.partial, batch.complete):
        gaps = [KDTree(points[:n]).query(points[n])[0] for n in range(1, len(points))]
        assert np.diff(gaps).max() <= 1e-6


@pytest.mark.parametrize("ordered", [True, False])
def test_a_cloud_of_too_few_points_is_repeated(example, ordered):
    few = example._replace(partial=example.partial[:40], ordered=ordered)
    partial = frame_example(few, FRAMING).partial
    assert len(np.unique(partial[:40], axis=0)) == 40
    assert np.array_equal(partial[40:], partial[:24])


def test_the_complete_cloud_does_not_decide_the_frame(example):
    """At test time there is none."""
    expected = frame_example(example, FRAMING)
    other = example._replace(complete=example.complete * 3 + 99)
    changed = frame_example(other, FRAMING)
    assert np.array_equal(changed.partial, expected.partial)
    assert np.array_equal(changed.eye, expected.eye)
    assert not np.array_equal(changed.complete, expected.complete)


def test_nor_does_the_number_of_points_that_the_network_takes(example):
    few = frame_example(example, FRAMING)
    many = frame_example(example, Framing(256, 128, 1.4))
    assert np.array_equal(few.scale, many.scale)
    assert np.array_equal(few.partial, many.partial[:64])


def test_the_scale_leads_to_the_unit_of_the_scores(example):
    """There the longest side of the complete cloud has length two."""
    example = example._replace(partial=example.partial / 3)
    batch = frame_example(example, Framing(64, len(example.complete), 1.4))
    scored = batch.complete * batch.scale
    assert np.ptp(scored, axis=0).max() == pytest.approx(2, rel=1e-5)
    far = example._replace(
        partial=example.partial * 40, complete=example.complete * 40, eye=None
    )
    assert frame_example(far, FRAMING).scale == pytest.approx(batch.scale, rel=1e-5)


def test_a_mirror_image_is_that_or_nothing_changes(example):
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


def test_what_may_have_any_heading_is_turned_about_the_vertical(example):
    """In training: the same shape in its workspace, each time in another direction."""
    turning = example._replace(any_heading=True)
    assert all(
        map(
            np.array_equal,
            frame_example(turning, FRAMING)[:4],
            frame_example(example, FRAMING)[:4],
        )
    )
    first = example.partial[0].astype(np.float64)
    angles = []
    for seed in range(8):
        batch = frame_example(
            turning._replace(ordered=True), FRAMING, np.random.default_rng(seed)
        )
        found = np.concatenate([batch.partial, batch.eye[None]])
        given = np.concatenate([example.partial[:64], example.eye[None]])
        found = found * np.ptp(given[:, 2]) / np.ptp(found[:, 2])
        found, given = found - found[0], given.astype(np.float64) - first
        np.testing.assert_allclose(found[:, 2], given[:, 2], atol=1e-5)
        flat_found, flat_given = (x[:, :2] @ [1, 1j] for x in (found, given))
        ratio = flat_found[1:] / flat_given[1:]
        if np.ptp(ratio.real) > 1e-3:
            ratio = -flat_found[1:].conj() / flat_given[1:]
        np.testing.assert_allclose(ratio, ratio[0], atol=1e-4)
        np.testing.assert_allclose(abs(ratio), 1, atol=1e-4)
        angles.append(np.angle(ratio[0]))
    assert np.ptp(angles) > 2 and len(np.unique(np.round(angles, 3))) == 8


def test_the_source_keeps_its_arrays(example):
    before = [np.array(array) for array in example[:3]]
    for seed in range(4):
        frame_example(example, FRAMING, np.random.default_rng(seed))
    assert all(map(np.array_equal, before, example[:3]))


def test_where_there_is_no_partial_one_is_cropped(example):
    """For a test always the same half; for training another one each time."""
    whole = example._replace(partial=None, ordered=True)
    direction = np.ones(3)
    gaps = np.linalg.norm(whole.complete.astype(np.float64) - direction, axis=1)
    half = whole.complete[gaps >= np.median(gaps)]
    expected = frame_example(whole._replace(partial=half, ordered=False), FRAMING)
    found = frame_example(whole, FRAMING)
    assert all(map(np.array_equal, found[:4], expected[:4]))
    cropped = [
        frame_example(whole, FRAMING, np.random.default_rng(seed)) for seed in range(4)
    ]
    # What a mirror leaves as it is.
    assert len({batch.partial[:, 1:].tobytes() for batch in cropped}) == 4


def test_without_a_complete_cloud_there_is_nothing_to_learn(example):
    for rng in (None, np.random.default_rng(0)):
        with pytest.raises(InputError, match="0: no complete cloud"):
            frame_example(example._replace(complete=None), FRAMING, rng)


def test_a_sensor_at_no_known_place_stands_in_front_left_and_above(example):
    batch = frame_example(example._replace(eye=None), FRAMING)
    np.testing.assert_allclose(batch.eye, [3**0.5] * 3, rtol=1e-6)


def test_stacked_examples_get_a_batch_axis(example):
    one = frame_example(example, FRAMING)._replace(indices={"a": np.arange(3)})
    both = stack([one, one])
    assert both.partial.shape == (2, 64, 3)
    assert both.scale.shape == (2,)
    assert both.indices["a"].shape == (2, 3)


def test_a_level_heading_is_found_whatever_the_pose(example):
    """In validation by the example's name; in training at random, tilts and quarter
    turns among them. The clouds stay together, and in the unit of the scores."""
    level = dataclasses.replace(FRAMING, heading="level")
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


@pytest.fixture(scope="module", params=["clear", "occluded+noisy", "rings"])
def seen(request):
    """An example that says what its sensor knows."""
    made = make_views("gearbox", 5, 1, request.param)
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


SPOILED = Augmentation(crop=0.7, thin=0.7, fewest=32, jitter=0.003)


@pytest.mark.parametrize("heading", ["given", "level"])
@pytest.mark.parametrize("augmentation", [None, SPOILED])
def test_what_the_sensor_knows_goes_with_the_clouds(seen, heading, augmentation):
    """Mirrored, turned, tilted, by quarters too, cropped and thinned: the points are
    on the surface, hardly any of the object is where the map says it is free, all as
    before; the camera stands at the eye, and its rotation is one."""
    framing = Framing(256, 512, 1.4, heading, augmentation)
    before = [look_up(seen.visibility, seen.partial[:256])]
    before.append(look_up(seen.visibility, seen.complete[:512]))
    signs = set()
    for seed in range(24):
        batch = frame_example(seen, framing, np.random.default_rng(seed))
        known = batch.visibility
        np.testing.assert_allclose(known.camera.position, batch.eye, atol=2e-4)
        np.testing.assert_allclose(np.linalg.det(known.camera.rotation), 1, atol=1e-5)
        signs.add(np.sign(np.linalg.det(_way(batch, seen))))
        # In the example's unit, half the longest side of the complete cloud.
        found = [look_up(known, cloud) for cloud in (batch.partial, batch.complete)]
        (state, depth), (_, of_complete) = ((s, d * batch.scale) for s, d in found)
        assert np.mean(of_complete < -0.15) < 0.04
        if augmentation is None:
            assert np.mean(state == SURFACE) > 0.99
            assert np.quantile(depth, 0.01) > -1e-3
            for (now, further), (was, depth) in zip(found, before, strict=True):
                same = now == was
                assert np.mean(same) > 0.99
                scaled = (further * batch.scale)[same]
                np.testing.assert_allclose(scaled, depth[same], atol=2e-3)
        else:
            # Noise carries some points into another pixel.
            assert np.mean(state == SURFACE) > 0.8
            assert np.median(np.abs(depth)) < 0.1
    assert heading == "level" or signs == {-1.0, 1.0}


def _way(batch, example):
    """The matrix that led from the example's points to the batch's."""
    given = example.complete[:512] - example.complete[:512].mean(axis=0)
    found = batch.complete - batch.complete.mean(axis=0)
    return np.linalg.lstsq(given, found, rcond=None)[0]


def test_for_a_test_the_map_is_in_the_workspace_too(seen):
    batch = frame_example(seen, FRAMING)
    state, _ = look_up(batch.visibility, batch.partial)
    assert np.mean(state == SURFACE) > 0.98
    spoiled = dataclasses.replace(FRAMING, augmentation=SPOILED)
    for one, two in zip(batch[:4], frame_example(seen, spoiled)[:4], strict=True):
        np.testing.assert_array_equal(one, two)


def test_maps_are_stacked_and_looked_up_for_a_whole_batch(seen):
    rng = np.random.default_rng(0)
    rows = [frame_example(seen, FRAMING, rng) for _ in range(3)]
    batch = stack(rows)
    state, behind = jax.vmap(look_up)(batch.visibility, batch.partial)
    for row, found, depth in zip(rows, state, behind, strict=True):
        expected = look_up(row.visibility, row.partial)
        assert np.mean(found == expected[0]) > 0.98
        same = found == expected[0]
        np.testing.assert_allclose(depth[same], expected[1][same], atol=1e-4)


def test_without_a_map_there_is_none_and_the_rest_is_the_same(seen):
    blind = seen._replace(visibility=None)
    for seed in range(4):
        one, two = (
            frame_example(example, FRAMING, np.random.default_rng(seed))
            for example in (seen, blind)
        )
        assert two.visibility is None
        for a, b in zip(one[:4], two[:4], strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_spoiled_partial_decides_the_workspace(example):
    """As it would at test time: cropped, it fills its own."""
    spoiled = dataclasses.replace(FRAMING, augmentation=Augmentation(crop=1.0))
    for seed in range(4):
        batch = frame_example(example, spoiled, np.random.default_rng(seed))
        assert np.abs(batch.partial).max() < 1 / 1.4 + 1e-6
        plain = frame_example(example, FRAMING, np.random.default_rng(seed))
        assert not np.array_equal(batch.partial, plain.partial)
        assert batch.complete.shape == plain.complete.shape


def test_rows_without_a_map_get_what_their_clouds_say_beside_others(seen):
    """And so does one whose packed map knows nothing, of which none was kept."""
    lost = seen._replace(visibility=nothing_known())
    rows = [frame_example(one, FRAMING) for one in (seen, lost)]
    assert rows[1].visibility is None
    batch = stack(rows)
    cloud, eye = jnp.asarray(batch.partial[1]), jnp.asarray(batch.eye[1])
    expected = seen_by(cloud, eye, "empty")
    state = batch.visibility.state
    assert np.mean(state[1] == expected.state) > 0.99
    np.testing.assert_array_equal(state[0], rows[0].visibility.state)
    assert stack([rows[1], rows[1]]).visibility is None
