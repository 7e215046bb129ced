"""Catalogues of Sweet Home 3D: what they say, and how their models stand."""

import struct
import zipfile

import numpy as np
import pytest
import trimesh

from experiments.simulation.objects.catalogues import read_catalogue, read_member
from prism_jax.io.errors import InputError
from tests.experiments.simulation.objects.conftest import entry, knobbed


@pytest.fixture
def read(tmp_path, write_catalogue):
    """The one model of a catalogue."""

    def one(*entries, **more):
        path = write_catalogue(tmp_path, "shop", entries, **more)
        version, models = read_catalogue(path, "CC0 1.0")
        assert version == "1.8"
        return models[0]

    return one


def knob_of(mesh: trimesh.Trimesh) -> np.ndarray:
    """The middle of the smaller part, from the middle of the larger."""
    parts = sorted(mesh.split(only_watertight=False), key=lambda part: part.area)
    return parts[0].bounds.mean(axis=0) - parts[1].bounds.mean(axis=0)


def test_models_stand_with_z_up_and_face_along_y(read):
    """The knob is on the front, high, and to the left of who looks at the front: a turn
    of the box, not its mirror image."""
    mesh = read(entry("fridge", knobbed(), "Fridge")).load()
    left, front, up = knob_of(mesh)
    assert left < -0.3 and front > 0.3 and up > 0.8
    np.testing.assert_allclose(mesh.extents, (1.0, 0.7, 2.0))
    assert mesh.volume > 0  # wound as before


def test_a_rotation_of_the_catalogue_is_applied_before_its_size(read):
    """A model that lies on its back: its own z is up, its own -y front."""
    lying = knobbed().apply_transform(
        trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))
    )
    np.testing.assert_allclose(lying.extents, (1.0, 0.7, 2.0), atol=1e-12)
    size = {"width": 1.0, "height": 2.0, "depth": 0.7}
    turn = "1 0 0 0 0 -1 0 1 0"
    turned = read(entry("fridge", lying, "Fridge", modelRotation=turn, **size)).load()
    upright = read(entry("fridge", knobbed(), "Fridge")).load()
    np.testing.assert_allclose(turned.vertices, upright.vertices, atol=1e-7)


def test_models_are_stretched_to_the_size_of_the_catalogue(read):
    size = {"width": 3.0, "height": 5.0, "depth": 7.0}
    mesh = read(entry("fridge", knobbed(), "Fridge", **size)).load()
    np.testing.assert_allclose(mesh.extents, (3.0, 7.0, 5.0))
    sheet = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    told = entry("sheet", knobbed(), "Sheet")[0]
    assert read((told, sheet)).load().extents[1] == 0.0


@pytest.mark.parametrize(
    "told",
    [
        {"width": "wide"},
        {"height": "0"},
        {"depth": "nan"},
        {"modelRotation": "1 0 0 1"},
        {"modelRotation": "1 0 0 0 1 0 0 0 inf"},
    ],
)
def test_an_entry_that_makes_no_sense_is_refused(read, told):
    with pytest.raises(InputError, match=r"shop\.sh3f: not a catalogue of models"):
        read(entry("fridge", knobbed(), "Fridge", **told))


def test_what_is_no_catalogue_is_refused(tmp_path, read):
    with pytest.raises(InputError, match="not a catalogue of models"):
        read(entry("fridge", knobbed(), "Fridge"), head="name=shop")
    (tmp_path / "text.sh3f").write_text("no archive")
    for name, told in (("text", "cannot be read"), ("none", "no such file")):
        with pytest.raises(InputError, match=rf"{name}\.sh3f: .*{told}|{told}"):
            read_catalogue(tmp_path / f"{name}.sh3f", "")


def test_a_mesh_that_is_missing_or_damaged_is_refused_when_it_is_loaded(read):
    told, _ = entry("fridge", knobbed(), "Fridge")
    with pytest.raises(InputError, match=r"fridge\.obj: no surface"):
        read((told, "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n")).load()
    with pytest.raises(InputError, match=r"fridge\.obj: not in the archive"):
        read((told, None)).load()


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
