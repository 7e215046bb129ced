"""Files appear whole or not at all."""

import fcntl
import os
import pathlib

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
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


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


def test_a_folder_and_a_name_too_long_leave_all_as_they_were(tmp_path):
    (tmp_path / "b").mkdir()
    for bad, reason in {"b": "is a folder", "n" * 256: "File name too long"}.items():
        with pytest.raises(InputError, match=f"{bad}: cannot be written .{reason}"):
            atomic.write_together({tmp_path / name: b"new" for name in ("a", bad)})
    assert os.listdir(tmp_path) == ["b"]


SPELLINGS = ["d/scan", "d/../d/scan", "../x/d/scan", "symbolic", "hard", "linked/scan"]


@pytest.mark.parametrize("given", ["d/scan", "d", "symbolic", "d/IMAGE.PNG"])
@pytest.mark.parametrize("target", SPELLINGS)
def test_what_is_read_is_not_replaced(given, target, tmp_path, monkeypatch):
    """However it is spelled."""
    (tmp_path / "x" / "d").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "x")
    monkeypatch.setattr(atomic, "_KEPT", [])
    name = "IMAGE.json" if given.endswith("PNG") else "scan"
    pathlib.Path("d", name).write_bytes(b"precious")
    os.symlink(f"d/{name}", "symbolic")
    os.symlink("d", "linked")
    os.link(f"d/{name}", "hard")
    target = target.replace("scan", name)
    atomic.keep([given])
    with pytest.raises(InputError, match="this is an input; choose another output"):
        atomic.write_together({"new": b"", target: b"other"})
    for names in ([target], ["d"]):
        with pytest.raises(InputError, match="this is an input"):
            atomic.set_aside(".", names)
    os.makedirs("previous")
    os.link("hard", "previous/hard")
    with pytest.raises(InputError, match="this is an input"):
        atomic.set_aside(".", ["nothing"])
    assert pathlib.Path("d", name).read_bytes() == b"precious"
    assert sorted(os.listdir()) == ["d", "hard", "linked", "previous", "symbolic"]


def test_a_folder_has_one_writer_who_removes_what_killed_ones_left(tmp_path):
    left = [atomic.aside(tmp_path / "name", end) for end in (".tmp", ".part.mcap")]
    atomic.keep([read := atomic.aside(tmp_path / "rescued", ".part.mcap")])
    for file in (*left, read, tmp_path / ".mine.tmp"):
        file.touch()
    other = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    with pytest.raises(InputError, match="another process writes here; wait"):
        atomic.claim(tmp_path)
    assert all(file.exists() for file in left)
    os.close(other)
    assert atomic.claim(tmp_path) == atomic.claim(tmp_path) == tmp_path
    assert sorted(os.listdir(tmp_path)) == [".mine.tmp", read.name]


def test_an_output_directory_is_made_where_it_can_be_written_to(tmp_path):
    made = atomic.make_output_dir(tmp_path / "a" / "b")
    assert made.is_dir() and os.listdir(made) == []
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "below", "/proc/nowhere"):
        with pytest.raises(InputError, match="cannot be written"):
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
