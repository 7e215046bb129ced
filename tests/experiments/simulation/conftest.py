"""The build of shapes that the tests of readers stand on too."""

from tests.data.conftest import digests, shapes_dir, train_config

__all__ = ["digests", "shapes_dir", "train_config"]
