"""Bytes of a user's file, or the reason why there are none."""

import os

import pytest

from prism_jax.io import InputError, files


def test_reads_all_bytes_of_a_file_and_of_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(b"\x00\xff\n")
    assert files.read_bytes(path) == b"\x00\xff\n"

    def refused(path, fault):
        with pytest.raises(InputError, match=fault):
            files.read_bytes(path)

    refused(tmp_path / "missing", "no such file")
    refused(tmp_path / "a\0b", "cannot be read")
    os.mkfifo(tmp_path / "pipe")
    refused(tmp_path / "pipe", "not a file")
    refused(tmp_path, "not a file")
    path.write_bytes(b"")
    refused(path, "empty file")
    # Too large is refused before it is read.
    os.truncate(path, files.MAX_FILE_BYTES + 1)
    refused(path, "too large")

    def refuse(self):
        raise PermissionError(13, "Permission denied")

    path.write_bytes(b"x")
    monkeypatch.setattr("pathlib.Path.read_bytes", refuse)
    refused(path, "Permission denied")


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("PRISM_JAX_CACHE", raising=False)
    assert files.default_cache_dir() == tmp_path / "prism_jax"
    monkeypatch.setenv("PRISM_JAX_CACHE", "")
    assert files.default_cache_dir() == tmp_path / "prism_jax"
    monkeypatch.setenv("PRISM_JAX_CACHE", str(tmp_path / "own"))
    assert files.default_cache_dir() == tmp_path / "own"
    monkeypatch.delenv("PRISM_JAX_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert files.default_cache_dir().parts[-2:] == (".cache", "prism_jax")


def test_without_a_home_the_cache_lasts_as_long_as_the_process(
    monkeypatch, tmp_path, capsys
):
    """No $HOME, and a user whom the password file does not know."""

    def unknown(uid):
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "XDG_CACHE_HOME", "PRISM_JAX_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    files._temporary_cache.cache_clear()
    folder = files.default_cache_dir()
    assert folder.parent == tmp_path
    assert files.default_cache_dir() == folder
    (told,) = capsys.readouterr().err.splitlines()
    assert "no home directory" in told and "PRISM_JAX_CACHE" in told
    files._temporary_cache.cache_clear()
    assert not folder.exists()
