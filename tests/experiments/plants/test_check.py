"""What held-out frames say, and what is made of it."""

import numpy as np
import pytest

from experiments.plants.check import LOOKS, Evidence, gather, verdict
from experiments.plants.frames import Unlabelled, read_frames


def evidence(hidden, contradicted=0.0):
    hidden = np.asarray(hidden)
    group = np.arange(len(hidden)) // 2
    return Evidence(group, hidden, hidden, np.full(len(hidden), contradicted))


BEFORE = evidence(np.linspace(0.1, 0.2, 12))


@pytest.mark.parametrize(
    ("after", "better"),
    [
        (evidence(0.8 * BEFORE.hidden), True),
        (evidence(0.95 * BEFORE.hidden), False),
        (BEFORE, False),
        (evidence(1.1 * BEFORE.hidden), False),
        (evidence(0.8 * BEFORE.hidden, contradicted=0.1), False),
        (evidence(0.8 * BEFORE.hidden, contradicted=0.005), True),
        (evidence(BEFORE.hidden * np.repeat([0.3, 1.2] * 3, 2)), False),
    ],
)
def test_better_is_nearer_to_what_was_hidden_and_no_fuller_of_errors(after, better):
    """By a tenth or more, and for certain, which the last one is in the mean alone."""
    found, told = verdict(BEFORE, after)
    assert found == better
    expected = after.hidden.mean() / BEFORE.hidden.mean() - 1
    assert np.isclose(told["change"], expected)
    assert told["hidden"] == [BEFORE.hidden.mean(), after.hidden.mean()]


@pytest.fixture(scope="module")
def frames(boxes, minimal):
    return read_frames(Unlabelled(boxes()), minimal.config)


def test_a_network_that_returns_what_it_gets_leaves_the_hidden_far(frames, minimal):
    def returning(variables, partials, eyes):
        return partials

    found = gather(returning, {}, frames, minimal.config)
    assert len(found.hidden) == LOOKS * len(frames)
    assert set(found.group) == set(range(6))
    np.testing.assert_allclose(found.kept, 0.0, atol=1e-7)
    assert (found.hidden > 0.02).all()
    assert found.contradicted.max() < 0.05
    again = gather(returning, {}, frames, minimal.config)
    np.testing.assert_array_equal(again.hidden, found.hidden)


def test_points_before_the_measured_surface_are_contradicted(frames, minimal):
    """By the sensor that was there, not by a second one. Of few sequences each frame is
    a group of its own."""

    def nearer(variables, partials, eyes):
        return 0.6 * partials + 0.4 * eyes[:, None]

    found = gather(nearer, {}, frames[:4], minimal.config)
    assert set(found.group) == set(range(4))
    assert (found.contradicted > 0.9).sum() >= 3
