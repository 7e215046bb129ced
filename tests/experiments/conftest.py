"""What the launchers' tests share."""

import pytest

from prism_jax.data.corpus import CorpusConfig, build_corpus


@pytest.fixture(scope="session")
def few_shapes(tmp_path_factory):
    """A folder with eight examples to train on and two to validate with."""
    folder = tmp_path_factory.mktemp("data")
    build_corpus(CorpusConfig("train", num_shapes=8, num_views=1), folder, 0, False)
    build_corpus(CorpusConfig("validation", num_shapes=2), folder, 0, False)
    return folder
