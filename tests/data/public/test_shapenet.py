"""ShapeNet-55 and ShapeNet-34, from a folder in PoinTr's layout."""

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from prism_jax.data.public.shapenet import SUBSETS, ShapeNet
from prism_jax.io import InputError

KEYS = ("02691156-1a04e3", "02958343-u6028-fe5f4")
SPLITS = [(subset, split) for subset, splits in SUBSETS.items() for split in splits]


@pytest.fixture(scope="module")
def root(tmp_path_factory, cloud, write):
    """Two models and all lists."""
    root = tmp_path_factory.mktemp("ShapeNet55-34")
    for seed, key in enumerate(KEYS):
        write(root / "shapenet_pc" / f"{key}.npy", cloud(seed, 8192))
    for subset, split in SPLITS:
        names = [f"{key}.npy\n" for key in KEYS]
        write(root / subset / f"{split}.txt", "".join(names))
    return root


@pytest.mark.parametrize(("subset", "split"), SPLITS)
def test_complete_clouds_are_normalised_and_left_to_be_cropped(
    root, cloud, subset, split
):
    source = ShapeNet(subset, root, split)
    assert source.categories == ("airplane", "car")
    assert len(source) == 2
    for seed, (example, key) in enumerate(zip(source, KEYS, strict=True)):
        assert (example.name, example.partial, example.eye) == (key, None, None)
        expected = cloud(seed, 8192).astype(np.float64)
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
    ("arguments", "fault"),
    [
        (("ShapeNet-Unseen21", "train"), "^split: unknown value 'train'; use test"),
        (("ShapeNet-56", "test"), "^subset: unknown value"),
        (("ShapeNet-55", "val"), "use one of train, test"),
    ],
)
def test_what_is_not_published_is_refused(root, arguments, fault):
    subset, split = arguments
    with pytest.raises(InputError, match=fault):
        ShapeNet(subset, root, split)


def test_missing_files_and_damaged_clouds_are_refused(tmp_path, write):
    write(tmp_path / "ShapeNet-34" / "train.txt", f"{KEYS[0]}.npy\n")
    with pytest.raises(InputError, match=rf"missing: shapenet_pc/{KEYS[0]}.npy;"):
        ShapeNet("ShapeNet-34", tmp_path, "train")
    path = write(tmp_path / "shapenet_pc" / f"{KEYS[0]}.npy", np.ones((8192, 3)))
    with pytest.raises(InputError, match=rf"{KEYS[0]}.npy: .*zero extent"):
        ShapeNet("ShapeNet-34", tmp_path, "train")[0]
    write(path, np.zeros((100, 3)))
    with pytest.raises(InputError, match=rf"{KEYS[0]}.npy: .*instead of 8192"):
        ShapeNet("ShapeNet-34", tmp_path, "train")[0]
