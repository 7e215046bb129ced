"""One small build of the shapes that the data tests share."""

import hashlib

import pytest

from experiments.simulation.shapes.build import ShapesConfig, build_shapes


@pytest.fixture(scope="session")
def train_config() -> ShapesConfig:
    """Four shapes of two views in shards of three and one."""
    return ShapesConfig("train", num_shapes=4, num_views=2, shard_shapes=3)


@pytest.fixture(scope="session")
def shapes_dir(train_config, tmp_path_factory):
    """Folder of a training and a validation split."""
    data_dir = tmp_path_factory.mktemp("shapes")
    validation = ShapesConfig("validation", num_shapes=3)
    for config in (train_config, validation):
        build_shapes(config, data_dir, num_workers=0, progress=False)
    return data_dir


@pytest.fixture(scope="session")
def digests():
    """``folder -> {file name: sha256}``."""

    def of(folder):
        return {
            path.name: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in folder.iterdir()
        }

    return of
