"""Files appear whole or not at all."""

import os
import stat

import pytest

from prism_jax.io import InputError, atomic


def test_writes_and_replaces(tmp_path):
    path = tmp_path / "a.bin"
    for data in (b"first", b"second, longer", b""):
        atomic.write_bytes(path, data)
        assert path.read_bytes() == data
    assert os.listdir(tmp_path) == ["a.bin"]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


@pytest.mark.parametrize("call", ["os.fsync", "os.replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left"), KeyboardInterrupt()])
def test_failure_leaves_the_old_file_and_no_other(tmp_path, monkeypatch, call, error):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def fail(*_):
        raise error

    monkeypatch.setattr(call, fail)
    expected = InputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        atomic.write_bytes(path, b"new" * 1000)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_an_output_directory_is_made_where_it_can_be_written_to(tmp_path):
    made = atomic.make_output_dir(tmp_path / "a" / "b")
    assert made.is_dir() and os.listdir(made) == []
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "below", "/proc/nowhere"):
        with pytest.raises(InputError, match="cannot be written to"):
            atomic.make_output_dir(path)


def test_an_earlier_runs_files_are_set_aside(tmp_path):
    assert not atomic.set_aside(tmp_path, ["a", "[0-9]"])
    for text in ("old", "new"):
        (tmp_path / "1").mkdir()
        for name in ("a", "mine", "1/b"):
            (tmp_path / name).write_text(text)
        assert atomic.set_aside(tmp_path, ["a", "[0-9]"])
        assert {*os.listdir(tmp_path)} == {"mine", "previous"}
        previous = tmp_path / "previous"
        assert (previous / "a").read_text() == (previous / "1/b").read_text() == text
