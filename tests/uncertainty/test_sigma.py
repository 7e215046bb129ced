"""Clues about single points, on clouds whose answers are known, and their sigmas."""

import json

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.models.config import ModelConfig
from prism_jax.preprocessing.observation import observe
from prism_jax.uncertainty.sigma import CLUES, PointErrors, clues_of, spread
from tests.uncertainty.test_evidence import EYE, square


def clues(points, prediction, asked=None, off=0.0, sensor=EYE, num_read=128):
    """By name, of the prediction or some of it. The workspace is the measured points'
    own box, so that the unit is theirs; other poses are completed `off` in z."""
    seen = observe(points, sensor, ModelConfig(margin=1.0))
    unit = np.asarray(seen.workspace.to_unit(prediction), np.float64)
    some = unit if asked is None else unit[asked]
    looks = [IndexedCloud(unit + [0, 0, z]) for z in (0.0, off, -2 * off)]
    found = clues_of(some, seen, seen.sampled(num_read), unit, looks)
    assert found.shape == (len(some), len(CLUES)) and np.isfinite(found).all()
    return dict(zip(CLUES, found.T, strict=True))


def test_distances_are_those_of_all_pairs():
    points, prediction = square(500), square(200, height=-0.3, seed=1)
    found = clues(points, prediction, off=0.7)
    pairs = np.sort(cdist(prediction, points), axis=1)
    np.testing.assert_allclose(found["measured"], pairs[:, 0], rtol=1e-2)
    own = np.sort(cdist(prediction, prediction), axis=1)
    np.testing.assert_allclose(found["predicted_2"], own[:, 2], rtol=1e-2)
    np.testing.assert_allclose(found["predicted_8"], own[:, 8], rtol=1e-2)
    other = cdist(prediction, prediction + [0, 0, 0.7]).min(axis=1)
    np.testing.assert_allclose(found["mirrored"], other, rtol=1e-2)
    np.testing.assert_allclose(found["all_mirrored"], other.mean(), rtol=1e-2)
    assert (found["turned"] > found["mirrored"]).all()
    assert (found["measured_8"] > found["measured"]).all()


def test_what_is_said_of_the_whole_scan():
    points = square(500)
    noisy = points + np.random.default_rng(2).normal(0, 0.02, points.shape)
    clean, rough = (clues(cloud, cloud - [0, 0, 0.3]) for cloud in (points, noisy))
    assert clean["roughness"].max() < 1e-6 and 0.01 < rough["roughness"][0] < 0.02
    assert clean["unexplained"][0] == pytest.approx(0.3, rel=0.05)
    assert np.ptp(clean["unexplained"]) == 0 and clean["num_points"][0] == 500
    thin = clues(points * [1, 0.5, 1], points)
    assert thin["middle_side"][0] == pytest.approx(0.5, rel=0.02)
    assert thin["shortest_side"][0] == 0


def test_what_the_sensor_says():
    """A point behind the square, one in front, and one beside it."""
    points = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 2), -1).reshape(-1, 2)
    points = np.column_stack([points, np.zeros(len(points))])
    three = np.array([[0, 0, -0.5], [0, 0, 0.5], [1.5, 0, 0]])
    found = clues(points, np.concatenate([three, square(50)]), asked=slice(3))
    np.testing.assert_allclose(found["behind"][:2], [0.5, -0.5], atol=1e-3)
    # Within half a step of the grid; then as far as the angle says at that distance.
    assert (found["beside"][:2] < 0.03).all()
    angle = np.arctan2(1.5, 6) - np.arctan2(1, 6)
    aside = 2 * np.sin(angle / 2) * np.hypot(1, 6)
    assert found["beside"][2] == pytest.approx(aside, rel=0.01)
    np.testing.assert_allclose(found["outside"], [0.5, 0.5, 0.5], atol=1e-3)
    np.testing.assert_allclose(found["height"], three[:, 2], atol=1e-3)


def test_slant_and_thickness_of_a_wall_and_a_floor():
    floor = square(300, height=-0.5)
    wall = floor[:, [0, 2, 1]] * [0.2, 0, 1]
    top = 300 + wall[:, 2].argmax()
    found = clues(square(300), np.concatenate([floor, wall]), asked=[0, top])
    ray = np.abs(floor[0] - EYE)
    assert found["slant"][0] == pytest.approx(ray[2] / np.linalg.norm(ray), abs=0.01)
    assert found["slant"][1] < 0.05
    assert found["thickness"].max() < 1e-3
    noisy = floor + np.random.default_rng(2).normal(0, 0.02, floor.shape)
    assert clues(square(300), noisy)["thickness"].mean() > 0.005


def test_far_from_the_origin_and_in_any_unit():
    points, prediction = square(400), square(100, height=-0.4, seed=1)
    away = np.array([4e5, 5e6, 10.0])
    here = clues(points, prediction, off=0.1)
    moved = [1e3 * cloud + away for cloud in (points, prediction, EYE)]
    there = clues(*moved[:2], off=0.1, sensor=moved[2])
    for name in CLUES:
        np.testing.assert_allclose(there[name], here[name], rtol=1e-3, atol=1e-5)


def test_few_collinear_and_repeated_points():
    few = square(2, height=0.1)
    clues(square(64), few[:1])
    clues(square(64), np.concatenate([few, few, few]))
    apart = np.ones((5, 3)) * [[1], [1], [1], [1], [2]]
    for points in (apart, square(20) * [1, 0, 1]):
        clues(points, square(30, height=0.3), sensor=None)
    assert clues(square(64), square(30), asked=[])["slant"].shape == (0,)


def test_sigma_is_the_exponential_of_the_trees_sum_within_what_was_met():
    """Twice as much where a clue is above a threshold."""
    doubling = PointErrors(
        base=np.log(0.01),
        looks_at=np.full((1, 1), float(CLUES.index("mirrored"))),
        thresholds=np.full((1, 1), 0.2),
        leaves=np.array([[0.0, np.log(2.0)]]),
        bounds=np.log([0.001, 1.0]),
    )
    rows = np.zeros((3, len(CLUES)))
    rows[1, CLUES.index("mirrored")] = 0.5
    np.testing.assert_allclose(doubling.sigma(rows), [0.01, 0.02, 0.01])
    fields = json.loads(json.dumps(doubling.to_dict()))
    np.testing.assert_allclose(PointErrors.from_dict(fields).sigma(rows)[1], 0.02)
    narrow = PointErrors.from_dict(fields | {"bounds": [-4.6, -4.6]})
    np.testing.assert_allclose(narrow.sigma(rows), np.exp(-4.6))
    for change in ({"looks_at": [[len(CLUES)]]}, {"leaves": [[1.0]]}, {"more": 1}):
        with pytest.raises(ValueError, match="an estimate of points' errors"):
            PointErrors.from_dict({**fields, **change})


def test_points_between_others_have_errors_between_theirs():
    known = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    sigma = np.array([1.0, 2.0, 4.0, 9.0])
    np.testing.assert_allclose(spread(known, known, sigma), sigma)
    middle = spread(np.array([[0.5, 0, 0]]), known, sigma)[0]
    # The third nearest is sqrt(5) times as far.
    assert middle == pytest.approx((3 + 4 / 5**0.5) / (2 + 1 / 5**0.5))
    scaled = spread(np.array([[500.0, 0, 0]]), 1e3 * known, sigma)[0]
    assert scaled == pytest.approx(middle)


def test_copies_and_few_known_points():
    twice = np.zeros((2, 3))
    assert spread(np.zeros((1, 3)), twice, np.array([1.0, 3.0])).tolist() == [2.0]
    assert spread(np.ones((2, 3)), twice[:1], np.array([3.0])).tolist() == [3.0, 3.0]
    assert np.isnan(spread(np.ones((2, 3)), twice[:0], np.zeros(0))).all()
