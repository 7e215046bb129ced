"""Models of Sweet Home 3D: what catalogues say, which are taken, and their views."""

import json
import struct
import zipfile

import numpy as np
import pytest
import trimesh

from experiments.simulation.build_dataset import build_dataset
from experiments.simulation.objects.build import ObjectsConfig, model_views
from experiments.simulation.objects.catalogues import (
    CATEGORIES,
    PACKAGE,
    read_catalogue,
    read_member,
)
from experiments.simulation.objects.survey import survey
from prism_jax.data.datasets import folder_of, open_dataset
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


def test_models_stand_with_z_up_and_face_along_y_in_the_catalogues_size(read):
    """The knob is on the front, high, and to the left of who looks at the front: a turn
    of the box, not its mirror image."""
    mesh = read(entry("fridge", knobbed(), "Fridge")).load()
    parts = sorted(mesh.split(only_watertight=False), key=lambda part: part.area)
    left, front, up = parts[0].bounds.mean(axis=0) - parts[1].bounds.mean(axis=0)
    assert left < -0.3 and front > 0.3 and up > 0.8
    np.testing.assert_allclose(mesh.extents, (1.0, 0.7, 2.0))
    assert mesh.volume > 0  # wound as before
    size = {"width": 3.0, "height": 5.0, "depth": 7.0}
    mesh = read(entry("fridge", knobbed(), "Fridge", **size)).load()
    np.testing.assert_allclose(mesh.extents, (3.0, 7.0, 5.0))


def test_a_rotation_of_the_catalogue_is_applied_before_its_size(read):
    """A model that lies on its back: its own z is up, its own -y front."""
    turn = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))
    lying = knobbed().apply_transform(turn)
    size = {"width": 1.0, "height": 2.0, "depth": 0.7}
    turn = "1 0 0 0 0 -1 0 1 0"
    found = read(entry("fridge", lying, "Fridge", modelRotation=turn, **size)).load()
    upright = read(entry("fridge", knobbed(), "Fridge")).load()
    np.testing.assert_allclose(found.vertices, upright.vertices, atol=1e-7)


def test_members_of_an_archive_are_read_or_refused(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("in/a.txt", b"\x00\xff\n" * 1000)
        written.writestr("other", b"x", zipfile.ZIP_LZMA)
    assert read_member(path, "in/a.txt", 3000) == b"\x00\xff\n" * 1000
    for name, fault in (
        ("none", "none: not in the archive"),
        ("in/a.txt", "size 3,000 bytes is not within 1 to 2,999"),
        ("other", "compression is not supported"),
    ):
        with pytest.raises(InputError, match=fault):
            read_member(path, name, 2999)
    # A member may be larger than it claims: 3,000 becomes 5 where its size is told.
    whole = path.read_bytes()
    size, lie = struct.pack("<I", 3000), struct.pack("<I", 5)
    for data in (whole[:-10], b"", whole.replace(size, lie)):
        path.write_bytes(data)
        with pytest.raises(InputError, match="cannot be read"):
            read_member(path, "in/a.txt", 3000)


def test_every_model_is_taken_or_left_out_with_a_reason(catalogue_dir):
    expected = {
        "test": (
            ["Scopia/fridge", "Scopia/red-ball"],
            {"Scopia/blue-ball": "looks like Scopia/red-ball"},
        ),
        "validation": (
            ["KatorLegaz/ring"],
            {
                "KatorLegaz/window": "belongs to a door or a window",
                "KatorLegaz/plug": "is a wall plate",
                "Reallusion/rug": "is flat",
            },
        ),
        "train": (
            ["BlendSwap-CC-0/cone", "BlendSwap-CC-BY/locker"],
            {
                "BlendSwap-CC-0/ball": "looks like Scopia/red-ball",
                "BlendSwap-CC-0/panel": "is a slab",
                "BlendSwap-CC-BY/bad": "cannot be read, or has no surface",
                "BlendSwap-CC-BY/sheet": "has 1 triangles",
            },
        ),
    }
    for split, (taken, left_out) in expected.items():
        found = survey([split], catalogue_dir)
        assert [model.identity for model, _ in found.models] == taken
        assert found.left_out == left_out


def test_items_are_the_views_of_model_after_model(
    catalogue_dir, tmp_path, write_catalogue
):
    """And follow from the model and the seed, whatever stands beside it."""
    settings = {"num_views": 2, "catalogue_dir": str(catalogue_dir)}
    build_dataset("objects", "train", tmp_path, 0, **settings)
    source = open_dataset("objects", "train", tmp_path)
    assert source.objects.tolist() == [0, 0, 1, 1]
    assert source.categories == CATEGORIES
    assert [source[0].category, source[2].category] == ["tool", "cabinet"]
    locker = entry("locker", knobbed((1, 1, 1), 0.4), "Locked locker")
    for name in ("Scopia", "KatorLegaz", "Reallusion", "BlendSwap-CC-0"):
        write_catalogue(tmp_path, name, [])
    write_catalogue(tmp_path, "BlendSwap-CC-BY", [locker])
    ((model, _),) = survey(["train"], tmp_path).models
    made = model_views(ObjectsConfig("train", 2), model)
    for view in range(2):
        example = source[2 + view]
        np.testing.assert_array_equal(example.partial, made.partials[view])
        np.testing.assert_array_equal(example.complete, made.complete)
        np.testing.assert_array_equal(example.eye, made.eyes[view])
        assert example.name == f"BlendSwap-CC-BY/locker/{view:02d}"
    other = model_views(ObjectsConfig("train", seed=1), model)
    assert not np.array_equal(other.complete, made.complete)

    manifest = folder_of("objects", "train", tmp_path) / "manifest.json"
    told = json.loads(manifest.read_text())
    assert told["package"] == PACKAGE
    assert [known["version"] for known in told["catalogues"]] == ["1.8", "1.8"]
    cone, locker = told["models"]
    assert cone["licence"] == "CC0 1.0" and locker["licence"] == "CC BY 3.0"
    assert (locker["creator"], locker["title"]) == ("Bob", "Locked locker")
    assert (locker["catalogue"], locker["name"]) == ("BlendSwap-CC-BY", "locker")
    assert told["left_out"]["BlendSwap-CC-0/panel"] == "is a slab"
