"""Lists, folders and clouds of published sets."""

import numpy as np
import pytest

from prism_jax.data.public import layout
from prism_jax.io import InputError


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\n \n", "no objects listed"),
        (b"a/1\n../secret\n", "invalid line '../secret', expected a pair"),
        (b"a/1\nb/2\na/1\n", "duplicate object"),
        (b"\xff\xfe\x00", "not a text file"),
    ],
)
def test_an_unsound_list_is_refused(tmp_path, content, fault):
    path = tmp_path / "a.list"
    path.write_bytes(content)
    with pytest.raises(InputError, match=fault):
        layout.read_list(path, r"(\w)/(\d)", "a pair")


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (np.zeros((0, 3)), "is not a cloud"),
        (np.zeros((4, 4)), "is not a cloud"),
        (np.zeros((4, 3), "S3"), "is not a cloud"),
        (np.full((4, 3), 1e300), "not finite"),
        (np.zeros((5, 3)), "5 points instead of 4"),
    ],
)
def test_an_unsound_cloud_is_refused(points, fault):
    with pytest.raises(InputError, match=rf"^file\.npy: .*{fault}"):
        layout.sound_cloud(points, "file.npy", 4)
