"""Where a completer works, and in what it is scored."""

import numpy as np
import pytest

from experiments.protocol import (
    NORMALISATIONS,
    Protocol,
    into_scored,
    observed,
    side_by_side,
    workspace_for,
)
from prism_jax.data.source import Example
from prism_jax.preprocessing.observation import UNKNOWN_EYE


def given(example, protocol):
    """The partial and the sensor's place, as a completer gets them."""
    (partial,), (eye,) = side_by_side([observed(example, protocol)])
    return partial, eye


METRES = {"scale": 0.35, "shift": (2.0, -1.0, 40.0)}


def reach(cloud) -> float:
    """The largest coordinate, by magnitude, of any axis."""
    return float(np.abs(cloud).max())


def test_each_normalisation_frames_its_own_cloud(boxes):
    example = boxes(**METRES)[1]
    partial, oracle, own = (
        workspace_for(example, Protocol(60, 1.4, name)).to_unit
        for name in ("partial", "oracle", "own")
    )
    assert np.isclose(reach(partial(example.partial)), 1 / 1.4, rtol=1e-5)
    assert np.isclose(reach(oracle(example.complete)), 1 / 1.4, rtol=1e-5)
    # The lower faces are not seen, so that the two cubes lie apart.
    assert np.abs(oracle(example.partial) - partial(example.partial)).max() > 0.01
    np.testing.assert_array_equal(own(example.partial), example.partial)


def test_scores_are_in_the_complete_clouds_unit_whatever_the_frame(boxes):
    example = boxes(**METRES)[1]
    for normalisation in NORMALISATIONS:
        scored, _ = into_scored(example, Protocol(60, 1.4, normalisation))
        complete = scored(example.complete)
        assert np.isclose(np.ptp(complete, axis=0).max(), 2, rtol=1e-12)
        assert np.isclose(reach(complete), 1, rtol=1e-12)
    own, _ = into_scored(example, Protocol(60, 1.4, unit="own"))
    np.testing.assert_array_equal(own(example.complete), example.complete)
    point = np.full((8, 3), 3.0, np.float32)
    once, _ = into_scored(Example(point, point, None, "dot", "dot"), Protocol(4, 1.4))
    np.testing.assert_array_equal(once(point), np.zeros((8, 3)))


@pytest.mark.parametrize("normalisation", ["partial", "oracle"])
def test_what_is_given_depends_on_no_unit_and_no_origin(boxes, normalisation):
    protocol = Protocol(60, 1.4, normalisation)
    here, there = (given(boxes(**how)[1], protocol) for how in ({}, METRES))
    for one, other in zip(here, there, strict=True):
        # Single precision holds coordinates of 40 m to 4e-6 m.
        np.testing.assert_allclose(one, other, atol=2e-5)
        assert one.dtype == np.float32
    assert here[0].shape == (60, 3)


def test_the_oracle_places_the_sensor_too(boxes):
    example = boxes()[0]
    partial, eye = given(example, Protocol(60, 1.25, "oracle"))
    np.testing.assert_allclose(eye, [0, 0, 4 / 1.25], atol=1e-6)
    rows = {tuple(row) for row in np.float32(example.partial / np.float32(1.25))}
    near = [min(np.abs(np.array(row) - p).max() for row in rows) for p in partial]
    assert max(near) < 1e-6
    # One that is unknown stands where training has it.
    for name in NORMALISATIONS:
        unknown = given(example._replace(eye=None), Protocol(60, 1.4, name))[1]
        np.testing.assert_array_equal(unknown, np.float32(UNKNOWN_EYE))
