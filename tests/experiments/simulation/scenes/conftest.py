"""One small build of scenes."""

import pytest

from experiments.simulation.scenes.build import ScenesConfig, build_scenes

CONFIG = ScenesConfig("validation", num_scenes=3, shard_scenes=2)


@pytest.fixture(scope="session")
def scenes_dir(tmp_path_factory):
    """Folder of three validation scenes in shards of two and one."""
    folder = tmp_path_factory.mktemp("scenes")
    build_scenes(CONFIG, folder, 0, progress=False)
    return folder
