"""ShapeNet-55, ShapeNet-34 and their like, from a folder in PoinTr's layout."""

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from prism_jax.data.public.shapenet import SUBSETS, ProjectedShapeNet, ShapeNet
from prism_jax.io import InputError

KEYS = ("02691156-1a04e3", "02958343-u6028-fe5f4")
SPLITS = [(subset, split) for subset, splits in SUBSETS.items() for split in splits]


@pytest.fixture(scope="module")
def root(tmp_path_factory, cloud, write):
    """Two models, all lists, and every projection."""
    root = tmp_path_factory.mktemp("ShapeNet55-34")
    for seed, key in enumerate(KEYS):
        write(root / "shapenet_pc" / f"{key}.npy", cloud(seed, 8192))
        synset, model = key.split("-", 1)
        for view in range(16):
            folder = root / "projected_partial_noise" / synset / model / "models"
            write(folder / f"{view}.pcd", cloud(100 * seed + view, 50 + view))
    for subset, split in SPLITS:
        names = [f"{key}.npy\n" for key in KEYS]
        write(root / subset / f"{split}.txt", "".join(names))
        projected = "".join(f"shapenet_pc/{name}" for name in names)
        write(root / f"Projected_{subset}_noise" / f"{split}.txt", projected)
    return root


@pytest.mark.parametrize(("subset", "split"), SPLITS)
def test_complete_clouds_are_normalised_and_left_to_be_cropped(root, subset, split):
    source = ShapeNet(subset, root, split)
    assert source.categories == ("airplane", "car")
    assert len(source) == 2
    for example, key in zip(source, KEYS, strict=True):
        assert (example.name, example.partial, example.eye) == (key, None, None)
        assert example.complete.shape == (8192, 3)
        np.testing.assert_allclose(example.complete.mean(axis=0), 0, atol=1e-6)
        radii = np.linalg.norm(example.complete, axis=1)
        np.testing.assert_allclose(radii.max(), 1, atol=1e-6)


def test_normalisation_keeps_shape_and_order(root, cloud):
    complete = ShapeNet("ShapeNet-55", root, "train")[0].complete
    stored = cloud(0, 8192)
    scale = np.ptp(stored, axis=0)[0] / np.ptp(complete, axis=0)[0]
    expected = stored[1:] - stored[:-1]
    np.testing.assert_allclose(scale * np.diff(complete, axis=0), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("difficulty", "kept"), [("easy", 6144), ("median", 4096), ("hard", 2048)]
)
def test_the_test_crops_take_the_points_nearest_to_the_corners(root, difficulty, kept):
    source = ShapeNet("ShapeNet-34", root, "test", difficulty=difficulty)
    examples = list(source)
    assert len(source) == len(examples) == 16
    assert len({example.name for example in examples}) == 16
    corners = []
    for example in examples[:8]:
        assert example.partial.shape == (kept, 3)
        tree = cKDTree(example.partial)
        left_out = tree.query(example.complete)[0] > 0
        removed = example.complete[left_out]
        assert len(removed) == 8192 - kept
        corner = np.sign(removed.mean(axis=0))
        corners.append(tuple(corner))
        distance = np.linalg.norm(example.partial - corner, axis=1)
        assert np.linalg.norm(removed - corner, axis=1).max() <= distance.min()
    assert len(set(corners)) == 8
    assert corners[0] == (1, 1, 1)


def test_all_difficulties_are_the_three_one_after_the_other(root):
    every = ShapeNet("ShapeNet-55", root, "test", difficulty="all")
    assert every.objects.tolist() == [0] * 24 + [1] * 24
    assert len({example.name for example in every}) == 48
    for i, difficulty in enumerate(("easy", "median", "hard")):
        one = ShapeNet("ShapeNet-55", root, "test", difficulty=difficulty)
        for view in (0, 5):
            example, other = every[24 + 8 * i + view], one[8 + view]
            assert example.name == other.name
            np.testing.assert_array_equal(example.partial, other.partial)


def test_items_are_the_same_in_every_process(root):
    source = ShapeNet("ShapeNet-55", root, "test", difficulty="hard")
    other = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(source[3].partial, other[3].partial)
    np.testing.assert_array_equal(source[3].complete, other[3].complete)


def test_projections_are_as_stored_sixteen_in_training_and_one_in_the_test(root, cloud):
    train = ProjectedShapeNet("ShapeNet-55", root, "train")
    test = ProjectedShapeNet("ShapeNet-Unseen21", root, "test")
    assert (len(train), len(test)) == (32, 2)
    example = train[16 + 5]
    np.testing.assert_array_equal(example.complete, cloud(1, 8192))
    np.testing.assert_array_equal(example.partial, cloud(105, 55))
    assert (example.category, example.name) == ("car", f"{KEYS[1]}/5")
    np.testing.assert_array_equal(test[1].partial, cloud(100, 50))
    assert len({item.name for item in train}) == 32


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
    for loader in (ShapeNet, ProjectedShapeNet):
        with pytest.raises(InputError, match=fault):
            loader(subset, root, split)


def test_the_published_model_without_an_id_is_one_like_the_others(
    tmp_path, cloud, write
):
    write(tmp_path / "ShapeNet-55" / "train.txt", "04379243-.npy\n")
    write(tmp_path / "shapenet_pc" / "04379243-.npy", cloud(0, 8192))
    example = ShapeNet("ShapeNet-55", tmp_path, "train")[0]
    assert (example.category, example.name) == ("table", "04379243-")


def test_an_unknown_difficulty_is_refused(root):
    with pytest.raises(InputError, match="use one of easy, median, hard, all"):
        ShapeNet("ShapeNet-55", root, "test", difficulty="medium")


def test_a_missing_list_and_missing_clouds_are_refused(tmp_path, write):
    with pytest.raises(InputError, match=r"ShapeNet-55/test.txt: no such file"):
        ShapeNet("ShapeNet-55", tmp_path, "test")
    write(tmp_path / "ShapeNet-55" / "test.txt", f"{KEYS[0]}.npy\n")
    with pytest.raises(InputError, match=rf"missing: shapenet_pc/{KEYS[0]}.npy;"):
        ShapeNet("ShapeNet-55", tmp_path, "test")


def test_missing_projections_are_refused(tmp_path, cloud, write):
    folder = tmp_path / "Projected_ShapeNet-34_noise"
    for split in ("train", "test"):
        write(folder / f"{split}.txt", f"shapenet_pc/{KEYS[0]}.npy\n")
    write(tmp_path / "shapenet_pc" / f"{KEYS[0]}.npy", cloud(0, 8192))
    models = tmp_path / "projected_partial_noise" / "02691156" / "1a04e3" / "models"
    write(models / "0.pcd", cloud(0, 5))
    assert len(ProjectedShapeNet("ShapeNet-34", tmp_path, "test")) == 1
    with pytest.raises(InputError, match=r"15 of the 16 files .*models/1.pcd, "):
        ProjectedShapeNet("ShapeNet-34", tmp_path, "train")


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (np.zeros((100, 3)), "100 points instead of 8192"),
        (np.ones((8192, 3)), "zero extent"),
        (np.full((8192, 3), np.inf), "not finite"),
        (np.zeros((8192, 2)), "not a valid NPY cloud"),
    ],
)
def test_a_damaged_cloud_is_refused_by_name(tmp_path, write, points, fault):
    write(tmp_path / "ShapeNet-34" / "train.txt", f"{KEYS[0]}.npy\n")
    write(tmp_path / "shapenet_pc" / f"{KEYS[0]}.npy", points)
    source = ShapeNet("ShapeNet-34", tmp_path, "train")
    with pytest.raises(InputError, match=rf"{KEYS[0]}.npy: .*{fault}"):
        source[0]
