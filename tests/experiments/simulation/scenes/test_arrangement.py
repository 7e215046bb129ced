"""Things set down beside each other, and what they stand on."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.scenes.arrangement import (
    SIZES,
    arranged,
    separation,
)

SQUARE = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])


@pytest.mark.parametrize(
    ("shift", "apart"), [((2.0, 0), 1), ((0.5, 3), 2), ((0.75, 0.5), -0.25)]
)
def test_polygons_are_apart_or_overlap(shift, apart):
    assert separation(SQUARE, SQUARE + shift) == pytest.approx(apart)
    assert separation(SQUARE + shift, SQUARE) == pytest.approx(apart)


@pytest.mark.parametrize("support", SIZES)
@pytest.mark.parametrize("seed", range(4))
def test_things_stand_beside_each_other_in_their_sizes(support, seed):
    rng = np.random.default_rng(seed)
    meshes = [trimesh.creation.box(rng.uniform(1, 5, 3)) for _ in range(8)]
    before = [mesh.vertices.copy() for mesh in meshes]
    placed = arranged(meshes, support, rng)
    for mesh, was in zip(meshes, before, strict=True):
        np.testing.assert_array_equal(mesh.vertices, was)
    for number, thing in enumerate(placed):
        assert thing.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        longest = np.linalg.norm(thing.vertices[0] - thing.vertices, axis=1).max()
        sides = meshes[number].extents
        size = longest / np.linalg.norm(sides) * sides.max()
        assert SIZES[support][0] <= size <= SIZES[support][1]
        for other in placed[:number]:
            both = [
                trimesh.convex.hull_points(t.vertices[:, :2]) for t in (thing, other)
            ]
            assert separation(*both) > 0
