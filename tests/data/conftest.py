"""One small built corpus that the data tests share."""

import pytest

from prism_jax.data.corpus import CorpusConfig, build_corpus


@pytest.fixture(scope="session")
def small_config() -> CorpusConfig:
    """Ten training examples in three shards."""
    return CorpusConfig(
        train_examples=10,
        validation_examples=2,
        test_examples=2,
        train_complete_points=512,
        evaluation_complete_points=512,
        shard_examples=4,
    )


@pytest.fixture(scope="session")
def small_corpus(small_config, tmp_path_factory):
    """Cache folder that holds the training split of `small_config`."""
    cache_dir = tmp_path_factory.mktemp("corpus")
    build_corpus("train", small_config, cache_dir, num_workers=0, progress=False)
    return cache_dir
