"""Bytes of a user's file, or the reason why there are none."""

import gc
import os

import pytest

from prism_jax.io import InputError, files


def test_reads_all_bytes(tmp_path):
    (tmp_path / "a").write_bytes(b"\x00\xff\n")
    assert files.read_bytes(tmp_path / "a") == b"\x00\xff\n"


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        files.read_bytes(tmp_path / "a")


def test_empty_file(tmp_path):
    (tmp_path / "a").touch()
    with pytest.raises(InputError, match="empty file"):
        files.read_bytes(tmp_path / "a")


def test_directory_and_pipe_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(InputError, match="not a file"):
            files.read_bytes(path)


def test_unreadable_file(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"x")

    def refuse(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.read_bytes", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        files.read_bytes(tmp_path / "a")


def test_name_that_no_file_can_have(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        files.read_bytes(tmp_path / "a\0b")


def test_file_too_large_is_refused_before_it_is_read(tmp_path):
    with open(tmp_path / "a", "wb") as file:
        file.truncate(files.MAX_FILE_BYTES + 1)
    with pytest.raises(InputError, match="too large"):
        files.read_bytes(tmp_path / "a")


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("PRISM_JAX_CACHE", raising=False)
    assert files.default_cache_dir() == tmp_path / "prism_jax"
    monkeypatch.setenv("PRISM_JAX_CACHE", str(tmp_path / "own"))
    assert files.default_cache_dir() == tmp_path / "own"
    monkeypatch.delenv("PRISM_JAX_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert files.default_cache_dir().parts[-2:] == (".cache", "prism_jax")


@pytest.fixture
def homeless(monkeypatch, tmp_path):
    """No $HOME, and a user whom the password file does not know."""

    def unknown(uid):
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "XDG_CACHE_HOME", "PRISM_JAX_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    files._temporary_cache.cache_clear()
    yield
    files._temporary_cache.cache_clear()


def test_without_a_home_the_cache_lasts_as_long_as_the_process(
    homeless, tmp_path, capsys
):
    folder = files.default_cache_dir()
    assert folder.parent == tmp_path
    assert files.default_cache_dir() == folder
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "no home directory" in told
    assert "PRISM_JAX_CACHE" in told
    files._temporary_cache.cache_clear()
    gc.collect()
    assert not folder.exists()
