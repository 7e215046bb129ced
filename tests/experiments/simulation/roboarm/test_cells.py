import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.cells import CellsConfig, build_cells, cell_views
from prism_jax.data.datasets import open_dataset


@pytest.fixture(scope="module")
def arms(model):
    return (model, dataclasses.replace(model, name="armed", tool_link="lower"))


@pytest.fixture(scope="module")
def config():
    return CellsConfig(
        "train",
        num_cells=3,
        num_frames=2,
        width=80,
        height=60,
        partial_points=128,
        complete_points=256,
    )


@pytest.fixture(scope="module")
def make(config, arms):
    def call(root, num_workers=0, **changes):
        changed = dataclasses.replace(config, **changes)
        return build_cells(changed, root, num_workers, False, arms)

    return call


@pytest.fixture(scope="module")
def built(make, tmp_path_factory):
    root = tmp_path_factory.mktemp("cells")
    make(root)
    return root


def test_a_built_set_opens_cell_by_cell(built, config, arms):
    source = open_dataset("cells", "train", built)
    assert source.objects.tolist() == [0, 0, 1, 1, 2, 2]
    assert source.categories == ("boxes", "armed")
    _, views = cell_views(config, 1, arms)
    for number, view in enumerate(views):
        example = source[2 + number]
        assert example.category == "armed" and example.name.startswith(
            f"000001/{number:02d}/"
        )
        assert example.any_heading and example.ordered
        step = 2 * np.ptp(view.complete, axis=0).max() / 2**16
        np.testing.assert_allclose(example.complete, view.complete, atol=step)
        np.testing.assert_array_equal(example.eye, view.eye)
        np.testing.assert_array_equal(example.visibility.state, view.visibility.state)
