"""Which points hang together."""

import numpy as np

from prism_jax.preprocessing.segmentation.parts import objects_of

UP, EYE = np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.1, 2.0])


def squares_and_a_chain(pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Two squares of points 1 cm apart, a chain of points so far apart from one to the
    other, and which of the three each point is of."""
    grid = np.stack(np.meshgrid(np.arange(30), np.arange(20)), axis=-1).reshape(-1, 2)
    square = np.pad(0.01 * grid, [(0, 0), (0, 1)])
    along = np.arange(0.29 + pitch, 0.7 - 0.5 * pitch, pitch)
    chain = np.stack([along, 0 * along + 0.1, 0 * along], axis=1)
    parts = square, square + (0.7, 0, 0), chain
    return np.concatenate(parts), np.repeat(range(3), [len(part) for part in parts])


def test_sparse_points_join_no_surfaces_and_dense_ones_do():
    for pitch in (0.018, 0.021):
        points, part = squares_and_a_chain(pitch)
        whole = objects_of(points, UP, EYE, None, 0.0)
        one, other = (np.unique(whole[part == number]) for number in (0, 1))
        assert len(one) == len(other) == 1 and one != other
    points, _ = squares_and_a_chain(0.01)
    bridge = np.concatenate([points, points + (0, 0.01, 0)])
    assert len(np.unique(objects_of(bridge, UP, EYE, None, 0.0))) == 1
