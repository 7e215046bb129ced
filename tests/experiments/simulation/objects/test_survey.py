"""Which models are taken, and why others are not."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.objects.survey import (
    digest_of,
    fault_of,
    survey,
)
from experiments.simulation.packing import normalised
from tests.experiments.simulation.objects.conftest import entry, knobbed


def names(found):
    return [model.identity for model, _ in found.models]


def test_every_model_is_taken_or_left_out_with_a_reason(catalogue_dir):
    test, validation, train = (
        survey([split], catalogue_dir) for split in ("test", "validation", "train")
    )
    assert names(test) == ["Scopia/fridge", "Scopia/red-ball"]
    assert test.left_out == {"Scopia/blue-ball": "looks like Scopia/red-ball"}
    assert names(validation) == ["KatorLegaz/ring"]
    assert validation.left_out == {
        "KatorLegaz/window": "belongs to a door or a window",
        "KatorLegaz/plug": "is a wall plate",
        "Reallusion/rug": "is flat",
    }
    assert names(train) == ["BlendSwap-CC-0/cone", "BlendSwap-CC-BY/locker"]
    assert train.left_out == {
        "BlendSwap-CC-0/ball": "looks like Scopia/red-ball",
        "BlendSwap-CC-0/panel": "is a slab",
        "BlendSwap-CC-BY/bad": "cannot be read, or has no surface",
        "BlendSwap-CC-BY/sheet": "has 1 triangles",
    }
    assert train.versions == {"BlendSwap-CC-0": "1.8", "BlendSwap-CC-BY": "1.8"}


@pytest.mark.parametrize(
    ("size", "fault"),
    [
        ((4, 2, 0.03), "is flat"),
        ((0.03, 4, 2), "is flat"),
        ((4, 2, 0.19), "is a slab"),
        ((4, 2, 0.21), None),
        ((4, 0.1, 0.05), None),
    ],
)
def test_thin_things_are_left_out_and_slender_ones_are_not(size, fault):
    assert fault_of(normalised(trimesh.creation.box(size))) == fault


def test_a_digest_tells_corners_and_nothing_else():
    mesh = normalised(knobbed())
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    place = np.argsort(order)
    shuffled = trimesh.Trimesh(
        mesh.vertices[order], place[mesh.faces][::-1, ::-1], process=False
    )
    nudged = trimesh.Trimesh(mesh.vertices + 1e-6, mesh.faces, process=False)
    assert digest_of(mesh) == digest_of(shuffled) == digest_of(nudged)
    mirrored = trimesh.Trimesh(mesh.vertices * (-1, 1, 1), mesh.faces, process=False)
    assert digest_of(mesh) != digest_of(mirrored)


def test_what_looks_alike_has_the_same_sides_and_cells(tmp_path, write_catalogue):
    """Two poles differ where a third of their width is another; a cube is no tower."""
    square = trimesh.creation.box((0.1, 4, 0.1))
    made = {
        "square": square,
        "round": trimesh.creation.cylinder(0.05, 4).apply_transform(
            trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
        ),
        "thicker": trimesh.creation.box((0.103, 4, 0.1)).subdivide(),
        "cube": trimesh.creation.box((1, 1, 1)),
        "tower": trimesh.creation.box((1, 1.3, 1)),
    }
    entries = [entry(name, mesh, name) for name, mesh in made.items()]
    write_catalogue(tmp_path, "Scopia", entries)
    found = survey(["test"], tmp_path)
    assert found.left_out == {"Scopia/thicker": "looks like Scopia/square"}
