"""ShapeNet-55 and ShapeNet-34, from a folder in PoinTr's layout."""

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from prism_jax.data.shapenet import SUBSETS, ShapeNet
from prism_jax.data.source import sound_cloud
from prism_jax.io import InputError
from tests.public_sets import KEYS, write_shapenet

SPLITS = [(subset, split) for subset, splits in SUBSETS.items() for split in splits]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two models and all lists."""
    root = tmp_path_factory.mktemp("ShapeNet55-34")
    for subset, split in SPLITS:
        write_shapenet(root, KEYS, subset, split)
    return root


@pytest.mark.parametrize(("subset", "split"), SPLITS)
def test_complete_clouds_are_normalised_and_left_to_be_cropped(root, subset, split):
    source = ShapeNet(subset, root, split)
    assert source.categories == ("airplane", "car")
    assert len(source) == 2
    for example, key in zip(source, KEYS, strict=True):
        assert (example.name, example.partial, example.eye) == (key, None, None)
        expected = np.load(root / "shapenet_pc" / f"{key}.npy").astype(np.float64)
        expected -= expected.mean(axis=0)
        expected /= np.linalg.norm(expected, axis=1).max()
        np.testing.assert_allclose(example.complete, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("difficulty", "kept"), [("easy", 6144), ("median", 4096), ("hard", 2048)]
)
def test_the_test_crops_take_the_points_nearest_to_the_corners(root, difficulty, kept):
    every = ShapeNet("ShapeNet-34", root, "test", difficulty="all")
    assert every.objects.tolist() == [0] * 24 + [1] * 24
    source = ShapeNet("ShapeNet-34", root, "test", difficulty=difficulty)
    source = pickle.loads(pickle.dumps(source))
    examples = list(source)
    assert len(source) == len({example.name for example in examples}) == 16
    number = ("easy", "median", "hard").index(difficulty)
    np.testing.assert_array_equal(
        every[24 + 8 * number + 5].partial, examples[8 + 5].partial
    )
    corners = []
    for example in examples[:8]:
        assert example.partial.shape == (kept, 3)
        tree = cKDTree(example.partial)
        removed = example.complete[tree.query(example.complete)[0] > 0]
        assert len(removed) == 8192 - kept
        corner = np.sign(removed.mean(axis=0))
        corners.append(tuple(corner))
        distance = np.linalg.norm(example.partial - corner, axis=1)
        assert np.linalg.norm(removed - corner, axis=1).max() <= distance.min()
    assert len(set(corners)) == 8
    assert corners[0] == (1, 1, 1)


@pytest.mark.parametrize(
    ("subset", "split", "fault"),
    [
        ("ShapeNet-Unseen21", "train", "^split: unknown value 'train'; use test"),
        ("ShapeNet-56", "test", "^subset: unknown value"),
        ("ShapeNet-55", "val", "use one of train, test"),
    ],
)
def test_what_is_not_published_is_refused(root, subset, split, fault):
    with pytest.raises(InputError, match=fault):
        ShapeNet(subset, root, split)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\n \n", "no objects listed"),
        (b"02691156-a.npy\n../secret\n", "invalid line '../secret', expected a line"),
        (b"02691156-.npy\n02691156-b.npy\n02691156-.npy\n", "duplicate object"),
        (b"\xff\xfe\x00", "not a text file"),
        (b"02691156-a.npy\n", "1 of the 1 files .* missing: shapenet_pc/02691156-a"),
    ],
)
def test_an_unsound_list_is_refused(tmp_path, content, fault):
    write_shapenet(tmp_path)
    (tmp_path / "ShapeNet-55" / "test.txt").write_bytes(content)
    with pytest.raises(InputError, match=fault):
        ShapeNet("ShapeNet-55", tmp_path, "test")


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (np.zeros((100, 3)), "100 points instead of 8192"),
        (np.full((8192, 3), 1e300), "not finite"),
        (np.ones((8192, 3)), "zero extent"),
    ],
)
def test_an_unsound_cloud_is_refused(tmp_path, points, fault):
    write_shapenet(tmp_path)
    np.save(tmp_path / "shapenet_pc" / f"{KEYS[0]}.npy", points)
    with pytest.raises(InputError, match=rf"{KEYS[0]}\.npy: .*{fault}"):
        ShapeNet("ShapeNet-55", tmp_path, "test")[0]
    with pytest.raises(InputError, match="not a sound cloud: no points"):
        sound_cloud(points[:0], "file.npy")
