"""Found objects against true things."""

import numpy as np
import pytest

from prism_jax.evaluation.segmentation import agreement
from prism_jax.observation.scene import LEFT_OVER, SUPPORT


def points(*runs: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """True labels and what is found, from runs of (count, label, found)."""
    counts, labels, found = np.array(runs).T
    return np.repeat(labels, counts), np.repeat(found, counts)


def test_what_is_found_whole_agrees_wholly():
    made = points((100, 0, 1), (80, 1, 0), (300, SUPPORT, SUPPORT), (9, LEFT_OVER, 1))
    found = agreement(*made, min_points=50)
    np.testing.assert_allclose(found.overlap, [100 / 109, 1])
    assert not (found.merged | found.split | found.lost).any()
    assert (found.support_recall, found.support_precision) == (1, 1)
    assert found.num_spurious == 0


def test_things_in_one_object_are_merged_and_a_small_one_is_not_asked_after():
    labels, found = points((100, 0, 0), (60, 1, 0), (80, 2, 1), (40, 3, 1))
    result = agreement(labels, found, min_points=50)
    np.testing.assert_allclose(result.overlap, [100 / 160, 60 / 160, 80 / 120])
    assert result.merged.tolist() == [True, True, True]
    assert len(agreement(labels, found, min_points=200).overlap) == 0


def test_a_thing_in_two_objects_is_split():
    labels, found = points((60, 0, 0), (40, 0, 1), (95, 1, 2), (5, 1, 3))
    result = agreement(labels, found, min_points=50)
    np.testing.assert_allclose(result.overlap, [0.6, 0.95])
    assert result.split.tolist() == [True, False]
    assert not result.merged.any()


def test_what_is_set_aside_or_left_over_is_lost():
    labels, found = points(
        (30, 0, 0), (50, 0, SUPPORT), (20, 0, LEFT_OVER), (100, SUPPORT, SUPPORT)
    )
    result = agreement(labels, found, min_points=50)
    assert result.lost.tolist() == [True]
    assert result.support_recall == 1
    assert result.support_precision == pytest.approx(100 / 150)


def test_an_object_of_nothing_is_spurious():
    labels, found = points(
        (100, 0, 0), (60, SUPPORT, 1), (40, LEFT_OVER, 1), (9, 0, 1), (40, SUPPORT, -1)
    )
    result = agreement(labels, found, min_points=50)
    assert result.num_spurious == 1
    assert result.support_recall == pytest.approx(0.4)


def test_nothing_found_at_all():
    labels, found = points((100, 0, LEFT_OVER), (10, LEFT_OVER, LEFT_OVER))
    result = agreement(labels, found, min_points=50)
    assert result.overlap.tolist() == [0] and result.lost.all()
    assert not (result.merged | result.split).any()
    assert np.isnan([result.support_recall, result.support_precision]).all()
