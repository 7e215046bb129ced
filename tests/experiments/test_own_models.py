"""Any folder of meshes."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from experiments.own_models import Meshes, build_meshes
from experiments.splits import parts_of
from prism_jax.data.datasets import open_dataset
from prism_jax.io import InputError


@pytest.fixture
def root(tmp_path):
    """Two splits; the box lies away from the origin, in every format."""
    box = trimesh.creation.box((4.0, 2.0, 1.0))
    box.apply_translation((10.0, -3.0, 7.0))
    for folder in ("train/boxes", "test/balls/one"):
        (tmp_path / folder).mkdir(parents=True)
    for suffix in ("obj", "off", "ply", "stl", "glb"):
        box.export(tmp_path / "train" / "boxes" / f"box.{suffix}")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=5.0)
    ball.export(tmp_path / "test" / "balls" / "one" / "model.STL")
    (tmp_path / "train" / "notes.md").write_text("not a mesh")
    return tmp_path


def test_every_format_gives_the_normalised_surface(root):
    source = Meshes(root / "train", num_points=1000)
    assert (len(source), source.categories) == (5, ("boxes",))
    half = np.array([1.0, 0.5, 0.25])
    for example in source:
        for cloud in (example.complete, example.partial):
            outside = np.abs(cloud / half).max(axis=1)
            np.testing.assert_allclose(outside, 1, atol=1e-5)
        np.testing.assert_allclose(example.complete.max(axis=0), half, rtol=0.03)
    assert len({example.name for example in source}) == 5


@pytest.mark.parametrize("suffix", ["npy", "xyz", "ply"])
def test_a_complete_cloud_is_seen_from_one_side(tmp_path, suffix):
    ball = np.random.default_rng(0).normal(size=(20000, 3))
    ball = 5 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [9, 9, 9]
    path = tmp_path / f"ball.{suffix}"
    if suffix == "ply":
        trimesh.PointCloud(ball).export(path)
    else:
        (np.save if suffix == "npy" else np.savetxt)(path, ball)
    (example,) = [*Meshes(tmp_path)]
    np.testing.assert_allclose(np.linalg.norm(example.complete, axis=1), 1, atol=0.01)
    # From outside, the unit ball is seen where p . eye >= 1.
    seen = example.complete @ example.eye >= 1
    assert seen.sum() == pytest.approx(len(example.partial), rel=0.03)
    assert np.mean(example.partial @ example.eye >= 0.95) > 0.99


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n"),
        ("a.stl", "no mesh"),
        ("a.glb", "glTF no mesh"),
        ("a.obj", ""),
    ],
)
def test_a_damaged_mesh_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=rf"{name}: "):
        Meshes(tmp_path)[0]


def test_they_are_packed_and_open_as_a_data_set(root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("built")

    def build(split):
        build_meshes(root / split, folder / "train", num_workers=0, progress=False)

    build("test")
    source, (given,) = open_dataset("packed", "train", folder), Meshes(root / "test")
    (found,) = (source[index] for index in range(len(source)))
    assert (found.name, found.category) == ("meshes/balls/one/model.STL", "balls")
    np.testing.assert_array_equal(found.eye, given.eye)
    # From distance d, the unit ball is seen where p . eye >= 1.
    least = 1 - 0.05 * np.linalg.norm(given.eye)
    assert (given.partial @ given.eye).min() > least
    gaps, _ = KDTree(given.complete).query(found.complete)
    assert found.complete.shape == (16384, 3) and gaps.max() < 1e-4
    assert parts_of("packed", folder) == ["meshes"]
    # Nothing is ray cast again, and other meshes do not go into the same folder.
    build("test")
    with pytest.raises(InputError, match=r"other settings \(categories, digests"):
        build("train")
