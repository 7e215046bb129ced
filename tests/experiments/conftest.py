"""What the launchers' tests share."""

import pytest

from prism_jax.evaluation import bootstrap
from prism_jax.simulation.shapes.build import ShapesConfig, build_shapes


@pytest.fixture(scope="module", autouse=True)
def few_resamples():
    """`tests/evaluation` looks at the intervals of as many as the figures have."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bootstrap, "_RESAMPLES", 50)
        yield


@pytest.fixture(scope="session")
def few_shapes(tmp_path_factory):
    """A folder with eight examples to train on and two to validate with."""
    folder = tmp_path_factory.mktemp("data")
    build_shapes(ShapesConfig("train", num_shapes=8, num_views=1), folder, 0, False)
    build_shapes(ShapesConfig("validation", num_shapes=2), folder, 0, False)
    return folder
