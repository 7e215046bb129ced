"""Ouster's captures, where its SDK is installed; else the hint."""

import importlib.util
import shutil

import numpy as np
import pytest

from prism_jax.io.errors import InputError
from prism_jax.io.streams import open_stream

NAME = "ouster/OS-0-128-U1_v2.3.0_1024x10"
INSTALLED = importlib.util.find_spec("ouster") is not None


@pytest.mark.skipif(INSTALLED, reason="ouster-sdk is installed")
def test_without_the_sdk_there_is_a_hint(tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(b"anything")
    with pytest.raises(InputError, match=r'pip install "prism_jax\[ouster\]"'):
        open_stream(path)


@pytest.mark.skipif(not INSTALLED, reason="ouster-sdk is not installed")
def test_a_capture_with_its_metadata_also_where_it_is_cut(real, tmp_path):
    stream = open_stream(real(f"{NAME}.pcap"))
    assert len(stream) == 1 and stream.topic == "122150000150"
    for _ in range(2):
        (frame,) = stream
        assert frame.points.shape == (97_299, 3)
        assert frame.frame_id == "os_sensor"
        assert frame.timestamp == 1_650_408_693_797_044_000
        # A sweep around the sensor, the nearest return beyond its own housing.
        away = np.linalg.norm(frame.points, axis=1)
        assert away.min() > 0.2 and 100 < away.max() < 200
    assert not stream.remarks
    data = real(f"{NAME}.pcap").read_bytes()
    (tmp_path / "cut.pcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="add the sensor's metadata"):
        open_stream(tmp_path / "cut.pcap")
    shutil.copy(real(f"{NAME}.json"), tmp_path / "cut.json")
    lines = []
    (frame,) = open_stream(tmp_path / "cut.pcap", tell=lines.append)
    assert 40_000 < len(frame.points) < 60_000
    (line,) = lines
    assert "sweep 0 is missing 528 of 1024 columns" in line
    with pytest.raises(InputError, match="no sweeps on 7"):
        open_stream(tmp_path / "cut.pcap", "7")
