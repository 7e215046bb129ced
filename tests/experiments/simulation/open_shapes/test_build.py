"""The open shapes on disk, and as a source."""

import numpy as np
import pytest

from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.open_shapes.build import OpenConfig
from experiments.simulation.shapes import category_rng
from experiments.simulation.shapes.build import build_shapes
from experiments.simulation.views import views_of
from prism_jax.data.datasets import open_dataset

CONFIG = OpenConfig(num_shapes=3, num_views=2, shard_shapes=2)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("open")
    build_shapes(CONFIG, folder, 0, progress=False)
    return folder


def test_items_are_the_views_of_shape_after_shape(data_dir):
    source = open_dataset("open", "train", data_dir)
    assert source.categories == ("open",)
    assert source.objects.tolist() == [0, 0, 1, 1, 2, 2]
    partials, complete, eyes, *_ = views_of(
        make_open_shape(2), category_rng("open", 2, 1), 2
    )
    for view in range(2):
        example = source[4 + view]
        np.testing.assert_array_equal(example.partial, partials[view])
        np.testing.assert_array_equal(example.complete, complete)
        np.testing.assert_array_equal(example.eye, eyes[view])
        assert example.name == f"000002/{view:02d}"
        assert example.category == "open"
        assert example.ordered and not example.any_heading
