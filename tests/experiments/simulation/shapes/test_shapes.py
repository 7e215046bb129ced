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

OFF_THE_FLOOR = {"chair", "table", "cabinet", "lamp", "mug", "airplane", "arm"}
"""What does not stand at z = 0 to the last bit."""


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_mesh_is_a_closed_solid_in_one_piece_of_its_size(category):
    mesh = make_shape(category, 2**40 + 7)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0 and mesh.body_count == 1
    assert mesh.extents.min() > 0.05 and 0.4 < mesh.extents.max() < 4.0
    lowest = mesh.bounds[0, 2]
    assert abs(lowest) < (0.2 if category in OFF_THE_FLOOR else 1e-9)
    # Winding by the parity of rays: a union leaves no inner walls.
    points, faces = mesh.sample(100, return_index=True, seed=0)
    step = 1e-5 * mesh.face_normals[faces]
    assert np.mean(~mesh.contains(points + step)) > 0.97
    assert np.mean(mesh.contains(points - step)) > 0.97


def test_training_unseen_and_novel_categories_part_the_whole():
    assert [len(TRAIN_CATEGORIES), len(set(CATEGORIES))] == [18, 30]
    assert len(UNSEEN_CATEGORIES) == len(NOVEL_CATEGORIES) == 6
    assert CATEGORIES == TRAIN_CATEGORIES + UNSEEN_CATEGORIES + NOVEL_CATEGORIES


def test_categories_have_independent_streams():
    draws = {category_rng(name, 3).integers(2**62) for name in CATEGORIES}
    assert len(draws) == len(CATEGORIES)


def test_unknown_category_and_negative_seed_are_named():
    with pytest.raises(ValueError, match="unknown category 'spoon': choose one of"):
        make_shape("spoon", 0)
    with pytest.raises(ValueError, match="negative"):
        make_shape("chair", -1)
