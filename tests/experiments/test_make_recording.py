"""The launcher that simulates a recording."""

import pytest

from experiments import make_recording
from prism_jax.data.recordings import RecordedCells
from prism_jax.io.streams import open_stream
from tests.launching import run

pytest.importorskip("mcap")


def test_a_short_recording(tmp_path, capsys):
    path = tmp_path / "new" / "cell.mcap"
    sizes = ["--num_frames=2", "--width=80", "--complete_points=256"]
    assert run(make_recording, f"--output={path}", *sizes) == 0
    printed = capsys.readouterr().out
    assert f"prism-stream {path} --camera={path.parent}/cell/000/000000" in printed
    assert len(open_stream(path)) == 2 and len(RecordedCells(path.parent / "cell")) == 2
    assert path.stat().st_size < 20_000
    assert run(make_recording, "--arm=nobody") == 2
    assert "no such arm 'nobody'; use one of panda" in capsys.readouterr().err
