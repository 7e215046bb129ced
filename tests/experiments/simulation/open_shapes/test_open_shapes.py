import numpy as np
import pytest

from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.open_shapes.attachments import extent
from experiments.simulation.open_shapes.compositions import composition
from experiments.simulation.shapes import category_rng
from prism_jax.data.datasets import OPEN_VERSION

SEEDS = (*range(10), 2**40 + 7)
AREA_AND_VOLUME = [
    (6.268437, 0.531621),
    (1.148053, 0.030268),
    (3.284124, 0.250464),
]
"""Of the first, the fourth and the last seed's mesh."""


@pytest.fixture(scope="module")
def meshes():
    return [make_open_shape(seed) for seed in SEEDS]


def test_meshes_are_closed_solids_in_one_piece(meshes):
    for mesh in meshes:
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0
        assert mesh.body_count == 1


def test_they_stand_on_the_floor_and_have_the_size_of_their_unit(meshes):
    for mesh in meshes:
        assert abs(mesh.bounds[0, 2]) < 1e-9
        assert 0.2 < mesh.extents.max() < 5.0


def test_faces_are_few_enough_to_be_cast_at_quickly(meshes):
    assert np.median([len(mesh.faces) for mesh in meshes]) < 3000


def test_no_two_are_alike(meshes):
    assert len({tuple(np.round(mesh.extents, 6)) for mesh in meshes}) == len(SEEDS)
    assert len({len(mesh.faces) for mesh in meshes}) > len(SEEDS) / 2


def test_many_are_the_same_on_their_left_and_right_and_some_are_not():
    alike = 0
    for seed in range(30):
        solid = composition(category_rng("open", seed))
        middle, _ = extent(solid)
        solid = solid.translate(-middle)
        apart = (solid - solid.mirror((1, 0, 0))).volume()
        alike += apart < 1e-3 * solid.volume()
    assert 8 < alike < 25


def test_same_seed_gives_the_same_bits(meshes):
    again = make_open_shape(SEEDS[0])
    np.testing.assert_array_equal(again.vertices, meshes[0].vertices)
    np.testing.assert_array_equal(again.faces, meshes[0].faces)


def test_shapes_are_those_of_the_generator_version(meshes):
    """A change of shapes needs a new OPEN_VERSION, or old caches mix with it."""
    assert OPEN_VERSION == 1, "renew AREA_AND_VOLUME"
    measured = [(meshes[k].area, meshes[k].volume) for k in (0, 3, -1)]
    np.testing.assert_allclose(measured, AREA_AND_VOLUME, atol=2e-6)


def test_a_negative_seed_is_named():
    with pytest.raises(ValueError, match="negative, got -1"):
        make_open_shape(-1)
