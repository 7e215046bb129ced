"""The live view, where rerun is installed."""

import numpy as np
import pytest

from prism_jax.io.errors import InputError
from prism_jax.io.streams.sinks import Labelled
from prism_jax.io.streams.view import RerunView

rerun = pytest.importorskip("rerun")

LABEL = np.repeat(np.arange(3, dtype=np.uint8), [400, 400, 200])


def test_frames_are_logged(tmp_path):
    path = tmp_path / "view.rrd"
    view = RerunView(path)
    points = np.random.default_rng(0).normal(size=(1000, 3))
    for number in range(3):
        view.write(Labelled(number, number * 10**8, points, LABEL))
    view.close()
    # One frame has 12,000 bytes of coordinates.
    assert path.stat().st_size > 20_000


def test_without_a_screen_there_is_a_hint(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="there is no screen"):
        RerunView()
