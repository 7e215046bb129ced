"""Manifests, and the files that they list."""

import json

import pytest

from experiments.splits import content_digest
from prism_jax.data.manifest import (
    MANIFEST,
    check_files,
    hash_files,
    read_manifest,
)
from prism_jax.io.errors import InputError


@pytest.fixture
def folder(tmp_path):
    """Three files, one of them in a folder, hidden ones, and their manifest."""
    for name in ("0.bin", "1.bin", "deep/2.bin", ".a.txt", "deep/.b/c.txt"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_bytes(name.encode())
    content = {"version": 1, "files": hash_files(tmp_path)}
    (tmp_path / MANIFEST).write_text(json.dumps(content))
    return tmp_path


def test_a_finished_build_of_the_expected_version_is_read(folder):
    manifest = read_manifest(folder, "build it", version=1)
    assert manifest["files"].keys() == {"0.bin", "1.bin", "deep/2.bin"}
    with pytest.raises(InputError, match=r"another version .*; delete it, then"):
        read_manifest(folder, "build it", version=2)
    with pytest.raises(InputError, match="not built yet; build it"):
        read_manifest(folder / "missing", "build it")


def test_the_digest_is_of_names_and_contents(folder):
    digest = content_digest(folder)
    assert len(digest) == 12
    files = read_manifest(folder, "")["files"]
    changed = files | {"1.bin": files["0.bin"]}
    (folder / MANIFEST).write_text(json.dumps({"files": changed}))
    assert content_digest(folder) not in (None, digest)
    (folder / MANIFEST).write_text(json.dumps({"files": None}))
    assert content_digest(folder) is None


def test_damaged_missing_and_further_files_are_named(folder):
    files = read_manifest(folder, "")["files"]
    check_files(folder, files, "delete it")
    path = folder / "deep" / "2.bin"
    path.write_bytes(b"!")
    with pytest.raises(InputError, match=r"deep/2\.bin: differs from .*; delete it"):
        check_files(folder, files, "delete it")
    path.unlink()
    with pytest.raises(InputError, match=r"2\.bin: missing but in the manifest"):
        check_files(folder, files, "delete it")
    path.write_bytes(b"deep/2.bin")
    (folder / "3.bin").touch()
    with pytest.raises(InputError, match=r"3\.bin: not in the manifest; move it"):
        check_files(folder, files, "delete it")
