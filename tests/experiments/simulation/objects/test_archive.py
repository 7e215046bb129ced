"""Members of zip archives."""

import struct
import zipfile

import pytest

from experiments.simulation.objects.archive import read_member
from prism_jax.io.errors import InputError


@pytest.fixture
def archive(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("in/a.txt", b"\x00\xff\n" * 1000)
        written.writestr("empty", b"")
        written.writestr("other", b"x", zipfile.ZIP_LZMA)
    return path


def test_reads_a_member_of_an_archive(archive):
    assert read_member(archive, "in/a.txt", 3000) == b"\x00\xff\n" * 1000


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("none", "none: not in the archive"),
        ("in/a.txt", "size 3,000 bytes is not within 1 to 2,999"),
        ("empty", "size 0 bytes"),
        ("other", "compression is not supported"),
    ],
)
def test_members_that_are_not_read(archive, name, fault):
    with pytest.raises(InputError, match=fault):
        read_member(archive, name, 2999)


def test_a_damaged_archive_or_member(archive, tmp_path):
    whole = archive.read_bytes()
    for data in (whole[:-10], b"no archive", b"", whole.replace(b"in/a", b"in/b", 1)):
        archive.write_bytes(data)
        with pytest.raises(InputError, match="cannot be read"):
            read_member(archive, "in/a.txt", 3000)
    for place in (tmp_path, tmp_path / "none.zip"):
        with pytest.raises(InputError, match=r"no such file|cannot be read"):
            read_member(place, "in/a.txt", 3000)


def test_a_member_larger_than_it_claims_is_not_taken(archive):
    """Both places of the archive that tell the size lie: 3,000 becomes 5."""
    size = struct.pack("<I", 3000)
    data = archive.read_bytes().replace(size, struct.pack("<I", 5))
    archive.write_bytes(data)
    with pytest.raises(InputError, match="cannot be read"):
        read_member(archive, "in/a.txt", 3000)
