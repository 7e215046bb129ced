"""Things set down beside each other, and what they stand on."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.scenes.arrangement import (
    SIZES,
    arranged,
    random_room,
    separation,
)
from prism_jax.observation.scene import LEFT_OVER, SUPPORT

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


@pytest.mark.parametrize("support", SIZES)
def test_what_is_around_holds_all_and_hides_nothing(support):
    things = [trimesh.creation.box((0.3, 0.2, 0.2)) for _ in range(2)]
    things[1].apply_translation((0.5, 0.4, 0))
    for thing in things:
        thing.apply_translation((0, 0, 0.1))
    walls = 0
    for seed in range(12):
        room = random_room(things, support, np.random.default_rng(seed))
        labels = [part.label for part in room.parts]
        assert room.support == support and labels[0] == SUPPORT
        assert (LEFT_OVER in labels) == (support == "table")
        top = room.parts[0].mesh
        assert top.bounds[1, 2] == pytest.approx(0, abs=1e-6)
        assert (top.bounds[0, :2] < (-0.15, -0.1)).all()
        assert (top.bounds[1, :2] > (0.65, 0.5)).all()
        for part in room.parts:
            above = part.mesh.bounds[1, 2] > 1e-6
            assert not above or part.mesh.bounds[0, 1] >= 0.5
            walls += above
    assert 0 < walls < 12
