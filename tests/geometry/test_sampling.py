"""Farthest-point sampling against a loop and the reference model's indices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.sampling import farthest_point_sample, resample

RNG = np.random.default_rng(0)
sample = jax.jit(farthest_point_sample, static_argnums=(1, 3))
jit_resample = jax.jit(resample, static_argnums=1)

REFERENCE_CASES = {
    "plain_1000to128",
    "near_origin_1000to128",
    "duplicates_1200to300",
    "zero_padded_256to128",
    "all_skipped_64to8",
    "exhausted_10to9",
}


def cloud(count: int = 60) -> np.ndarray:
    return RNG.normal(size=(count, 3)).astype(np.float32)


def looped_sample(points, num_samples, start=0):
    """Each next index maximises the smallest distance to the indices so far."""
    points = np.asarray(points, np.float32)
    chosen = [start]
    while len(chosen) < num_samples:
        offsets = points[:, None] - points[None, chosen]
        chosen.append(int((offsets**2).sum(-1).min(axis=1).argmax()))
    return np.array(chosen)


def test_agrees_with_a_loop():
    """A shorter sample is a prefix, and far away the choice is the same."""
    # Multiples of 1/64 near 1,000: the shift is exact, and so must be the choice.
    points = np.round(64 * cloud()) / np.float32(64)
    for start in (0, 7):
        expected = looped_sample(points, 60, start)
        assert np.array_equal(sample(points, 60, start), expected)
        assert np.array_equal(sample(points + 1024, 60, start), expected)
        # A power of two, exact as well: squares up to 1e13.
        assert np.array_equal(sample(2.0**20 * points, 60, start), expected)
        assert np.array_equal(sample(points, 25, start), expected[:25])


def test_agrees_with_the_reference_model(golden):
    ops = golden("ops.npz")
    cases = {name.split("/")[1] for name in ops if name.startswith("fps/")}
    assert cases == REFERENCE_CASES
    for case in cases:
        points = ops[f"fps/{case}/xyz"]
        by_cuda = ops[f"fps/{case}/idx_cuda_ties"]
        found = np.asarray(sample(points, len(by_cuda), 0, True))
        assert np.array_equal(points[found], points[by_cuda]), case
        assert np.array_equal(found, ops[f"fps/{case}/idx_lowest_ties"]), case


def test_points_near_the_origin_are_skipped_only_on_request():
    points = jnp.array([[1.0, 0, 0], [0.0, 0.03, 0], [-0.03, 0, 0], [0.0, 1.0, 0]])
    assert np.array_equal(sample(points, 4, 0, True), [0, 3, 0, 0])
    assert sorted(np.asarray(sample(points, 4, 0, False))) == [0, 1, 2, 3]
    # The start is taken wherever it lies.
    assert np.array_equal(sample(points, 4, 1, True), [1, 0, 3, 0])


def test_every_distinct_point_comes_before_any_repeat():
    points = np.repeat(cloud(20), 3, axis=0)
    found = np.asarray(sample(points, 25, 0))
    assert len(np.unique(points[found[:20]], axis=0)) == 20
    assert np.all(found[20:] == 0)
    assert np.all(sample(np.ones_like(points), 25, 0) == 0)


def test_no_gradient_flows_through_the_choice():
    """And of a cloud that is repeated it counts the copies."""
    points = jnp.asarray(cloud())
    gradient = jax.grad(lambda p: (p[sample(p, 25, 0)] ** 2).sum())(points)
    expected = np.zeros((60, 3))
    kept = looped_sample(points, 25)
    expected[kept] = 2 * np.asarray(points)[kept]
    assert np.allclose(gradient, expected)
    gradient = jax.grad(lambda p: jit_resample(p, 100).sum())(points)
    copies = np.bincount(looped_sample(points, 60)[np.arange(100) % 60])
    assert np.array_equal(gradient, np.repeat(copies[:, None], 3, axis=1))


def test_resample_thins_by_farthest_points_and_repeats_cyclically():
    points = cloud()
    order = looped_sample(points, 60)
    assert np.array_equal(jit_resample(points, 20), points[order[:20]])
    assert np.array_equal(jit_resample(points, 100), points[np.resize(order, 100)])
    one = jit_resample(points[:1], 4)
    assert np.array_equal(one, np.repeat(points[:1], 4, axis=0))


def test_vmap():
    clouds = np.stack([cloud(), cloud()])
    found = jax.jit(jax.vmap(lambda p: farthest_point_sample(p, 20)))(clouds)
    for i in range(2):
        assert np.array_equal(found[i], looped_sample(clouds[i], 20))


def test_an_empty_cloud_is_refused():
    for sampled in (farthest_point_sample, resample):
        with pytest.raises(ValueError, match="empty cloud"):
            sampled(jnp.zeros((0, 3)), 4)
