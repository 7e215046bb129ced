import numpy as np
import pytest

from experiments.simulation.shapes import (
    CATEGORIES,
    NOVEL_CATEGORIES,
    TRAIN_CATEGORIES,
    UNSEEN_CATEGORIES,
    category_rng,
    make_shape,
)
from prism_jax.data.datasets import SHAPES_VERSION

SEEDS = (0, 1, 2**40 + 7)
OFF_THE_FLOOR = {
    *("chair", "table", "cabinet", "lamp", "mug", "airplane", "arm"),
}
"""What does not stand at z = 0 to the last bit."""

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
    "bed": (12.699934, 1.894502),
    "machine_frame": (5.281766, 0.066427),
    "conveyor": (4.695516, 0.147638),
    "gearbox": (1.475136, 0.058765),
    "pipe_run": (2.886233, 0.053110),
    "pallet": (5.635306, 0.349655),
    "control_cabinet": (7.333429, 0.874739),
    "fixture": (2.459753, 0.070592),
    "bench": (2.242961, 0.027776),
    "bowl": (1.454723, 0.020995),
    "monitor": (0.735401, 0.013066),
    "gantry": (8.761483, 0.229457),
    "gripper": (8.393856, 0.509880),
    "valve": (0.815131, 0.020034),
    "ladder": (0.859276, 0.009099),
    "fan": (2.350799, 0.015364),
    "bicycle": (1.858277, 0.011738),
    "forklift": (1.673339, 0.037592),
    "pump": (0.853794, 0.022365),
    "tank": (9.124685, 1.256880),
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


def test_meshes_have_the_size_of_their_unit_and_most_stand_on_the_floor(meshes):
    category, shapes = meshes
    for mesh in shapes:
        assert mesh.extents.min() > 0.05 and 0.4 < mesh.extents.max() < 4.0
        if category not in OFF_THE_FLOOR:
            assert abs(mesh.bounds[0, 2]) < 1e-9


def test_same_seed_gives_the_same_bits(meshes):
    category, shapes = meshes
    again = make_shape(category, SEEDS[0])
    np.testing.assert_array_equal(again.vertices, shapes[0].vertices)
    np.testing.assert_array_equal(again.faces, shapes[0].faces)


def test_shapes_are_those_of_the_generator_version(meshes):
    """A change of shapes needs a new SHAPES_VERSION, or old caches mix with it."""
    category, shapes = meshes
    assert SHAPES_VERSION == 2, "renew AREA_AND_VOLUME"
    measured = (shapes[-1].area, shapes[-1].volume)
    np.testing.assert_allclose(measured, AREA_AND_VOLUME[category], atol=2e-6)


def test_other_seeds_give_other_shapes(meshes):
    _, shapes = meshes
    ratios = {tuple(np.round(mesh.extents / mesh.extents[2], 3)) for mesh in shapes}
    assert len(ratios) == len(SEEDS)


def test_seeds_differ_by_more_than_scale(meshes):
    """Other parts make other triangulations."""
    _, shapes = meshes
    assert len({len(mesh.faces) for mesh in shapes}) > 1


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


def test_training_unseen_and_novel_categories_part_the_whole():
    assert len(TRAIN_CATEGORIES) == 18
    assert set(UNSEEN_CATEGORIES) == {
        *("bench", "bowl", "monitor"),
        *("gantry", "gripper", "valve"),
    }
    assert set(NOVEL_CATEGORIES) == {
        *("ladder", "fan", "bicycle"),
        *("forklift", "pump", "tank"),
    }
    assert len(set(CATEGORIES)) == 30
    assert CATEGORIES == TRAIN_CATEGORIES + UNSEEN_CATEGORIES + NOVEL_CATEGORIES


def test_categories_have_independent_streams():
    draws = {category_rng(name, 3).integers(2**62) for name in CATEGORIES}
    assert len(draws) == len(CATEGORIES)


def test_unknown_category_and_negative_seed_are_named():
    with pytest.raises(ValueError, match="unknown category 'spoon': choose one of"):
        make_shape("spoon", 0)
    with pytest.raises(ValueError, match="negative"):
        make_shape("chair", -1)
