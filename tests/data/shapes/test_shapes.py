import numpy as np
import pytest

from prism_jax.data.corpus import GENERATOR_VERSION
from prism_jax.data.shapes import CATEGORIES, category_rng, make_shape

SEEDS = (0, 1, 2**40 + 7)
AREA_AND_VOLUME = {
    "chair": (1.214175, 0.019598),
    "table": (1.258672, 0.028628),
    "sofa": (10.264744, 0.983385),
    "cabinet": (11.971868, 0.138444),
    "lamp": (0.830048, 0.046535),
    "bottle": (0.890752, 0.046015),
    "mug": (3.297061, 0.085431),
    "airplane": (2.223465, 0.067235),
    "car": (9.715099, 1.314908),
    "arm": (2.392062, 0.105262),
}
"""Of the last seed's mesh, by `make_shape(category, SEEDS[-1])`."""


@pytest.fixture(scope="module", params=CATEGORIES)
def meshes(request):
    return request.param, [make_shape(request.param, seed) for seed in SEEDS]


def test_meshes_are_closed_solids_in_one_piece(meshes):
    _, shapes = meshes
    for mesh in shapes:
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0
        assert mesh.body_count == 1


def test_same_seed_gives_the_same_bits(meshes):
    category, shapes = meshes
    again = make_shape(category, SEEDS[0])
    np.testing.assert_array_equal(again.vertices, shapes[0].vertices)
    np.testing.assert_array_equal(again.faces, shapes[0].faces)


def test_shapes_are_those_of_the_generator_version(meshes):
    """A change of shapes needs a new GENERATOR_VERSION, or old caches mix with it."""
    category, shapes = meshes
    assert GENERATOR_VERSION == 1, "renew AREA_AND_VOLUME"
    measured = (shapes[-1].area, shapes[-1].volume)
    np.testing.assert_allclose(measured, AREA_AND_VOLUME[category], atol=2e-6)


def test_other_seeds_give_other_shapes(meshes):
    _, shapes = meshes
    ratios = {tuple(np.round(mesh.extents / mesh.extents[2], 3)) for mesh in shapes}
    assert len(ratios) == len(SEEDS)


def test_union_leaves_no_inner_walls(meshes):
    """Winding by ray parity: points just outside a surface sample are outside."""
    _, shapes = meshes
    mesh = shapes[0]
    points, faces = mesh.sample(200, return_index=True, seed=0)
    outside = points + 1e-5 * mesh.face_normals[faces]
    inside = points - 1e-5 * mesh.face_normals[faces]
    assert np.mean(~mesh.contains(outside)) > 0.98
    assert np.mean(mesh.contains(inside)) > 0.98


@pytest.mark.parametrize("category", ["chair", "table", "cabinet", "car", "sofa"])
def test_furniture_and_cars_are_upright_and_centred_sideways(category):
    bounds = np.array([make_shape(category, seed).bounds for seed in range(8)])
    np.testing.assert_allclose(bounds[:, 0, 0], -bounds[:, 1, 0], atol=0.15)
    assert np.all(bounds[:, 0, 2] > -0.05)


def test_categories_have_independent_streams():
    draws = {category_rng(name, 3).integers(2**62) for name in CATEGORIES}
    assert len(draws) == len(CATEGORIES)


def test_unknown_category_and_negative_seed_are_named():
    with pytest.raises(ValueError, match="unknown category 'spoon': choose one of"):
        make_shape("spoon", 0)
    with pytest.raises(ValueError, match="negative"):
        make_shape("chair", -1)
