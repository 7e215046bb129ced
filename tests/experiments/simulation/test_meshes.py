"""Any folder of meshes."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from experiments.simulation.packing import Meshes, build_meshes
from prism_jax.data.datasets import open_dataset, parts_of
from prism_jax.io import InputError

BOX = trimesh.creation.box((4.0, 2.0, 1.0))
BALL = trimesh.creation.icosphere(subdivisions=3, radius=5.0)


def save(mesh, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)


@pytest.fixture
def root(tmp_path):
    """Two splits; the box lies away from the origin, in every format."""
    box = BOX.copy()
    box.apply_translation((10.0, -3.0, 7.0))
    for suffix in ("obj", "off", "ply", "stl", "glb"):
        save(box, tmp_path / "train" / "boxes" / f"box.{suffix}")
    save(BALL, tmp_path / "train" / "ball.ply")
    save(BALL, tmp_path / "test" / "balls" / "one" / "model.STL")
    (tmp_path / "train" / "notes.md").write_text("not a mesh")
    return tmp_path


def test_every_format_gives_the_normalised_surface(root):
    source = Meshes(root / "train", num_points=3000)
    assert (len(source), source.categories) == (6, ("boxes", "mesh"))
    half = np.array([1.0, 0.5, 0.25])
    boxes = [example for example in source if example.category == "boxes"]
    assert len(boxes) == 5
    for example in boxes:
        np.testing.assert_allclose(
            np.abs(example.complete / half).max(axis=1), 1, atol=1e-5
        )
        np.testing.assert_allclose(example.complete.max(axis=0), half, rtol=0.02)
        np.testing.assert_allclose(example.complete.min(axis=0), -half, rtol=0.02)
        np.testing.assert_allclose(
            np.abs(example.partial / half).max(axis=1), 1, atol=1e-5
        )
    assert len({example.name for example in source}) == 6


def test_the_partial_is_what_the_eye_sees_of_a_ball(root):
    example = Meshes(root / "test", num_points=500)[0]
    assert (example.category, example.name) == ("balls", "balls/one/model.STL")
    assert example.complete.shape == (500, 3)
    distance = np.linalg.norm(example.eye)
    # From distance d, the unit ball is seen where p . eye >= 1.
    assert (example.partial @ example.eye).min() > 1 - 0.05 * distance
    assert len(example.partial) > 1000


def test_a_folder_that_is_missing_or_holds_no_mesh_is_refused(root):
    with pytest.raises(InputError, match=r"val: no such folder"):
        Meshes(root / "val")
    (root / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: no meshes \(.obj .off"):
        Meshes(root / "empty")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n"),
        ("a.stl", "no mesh"),
        ("a.glb", "glTF no mesh"),
        ("a.obj", ""),
    ],
)
def test_a_damaged_mesh_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    source = Meshes(tmp_path)
    with pytest.raises(InputError, match=rf"{name}: "):
        source[0]


def test_they_are_packed_and_open_as_a_data_set(root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("built")
    build_meshes(root / "test", folder / "train", num_workers=0, progress=False)
    source, (given,) = open_dataset("packed", "train", folder), Meshes(root / "test")
    assert (len(source), source[0].category) == (1, "balls")
    assert source[0].name == "meshes/balls/one/model.STL"
    np.testing.assert_array_equal(source[0].eye, given.eye)
    gaps, _ = KDTree(given.complete).query(source[0].complete)
    assert source[0].complete.shape == (16384, 3) and gaps.max() < 1e-4
    assert parts_of("packed", folder) == ["meshes"]
    # Nothing is ray cast anew, and other meshes do not go into the same folder.
    build_meshes(root / "test", folder / "train", num_workers=0, progress=False)
    with pytest.raises(InputError, match=r"other settings \(categories, digests"):
        build_meshes(root / "train", folder / "train", num_workers=0, progress=False)
