"""Completion3D, from a folder in its layout."""

import pickle

import numpy as np
import pytest

from prism_jax.data.public.completion3d import Completion3D
from prism_jax.io import InputError


@pytest.fixture
def root(tmp_path, cloud, write):
    """Two models in train and val, two numbered clouds in the test."""
    keys = ("02958343/b2", "02691156/a1")
    for split in ("train", "val"):
        write(tmp_path / f"{split}.list", "\n".join(keys) + "\n")
        for seed, key in enumerate(keys):
            write(tmp_path / split / "gt" / f"{key}.h5", {"data": cloud(seed, 2048)})
            path = tmp_path / split / "partial" / f"{key}.h5"
            write(path, {"data": cloud(10 + seed, 300).astype(np.float64)})
    write(tmp_path / "test.list", "all/0000\nall/0001\n")
    for seed in range(2):
        path = tmp_path / "test" / "partial" / "all" / f"000{seed}.h5"
        write(path, {"data": cloud(20 + seed, 300)})
    return tmp_path


@pytest.mark.parametrize("split", ["train", "val"])
def test_pairs_are_as_stored(root, cloud, split):
    source = Completion3D(root, split)
    assert (len(source), source.categories) == (2, ("airplane", "car"))
    example = source[1]
    np.testing.assert_array_equal(example.complete, cloud(1, 2048))
    np.testing.assert_array_equal(example.partial, cloud(11, 300))
    assert (example.category, example.name) == ("airplane", "02691156/a1")
    assert example.eye is None
    assert example.partial.dtype == np.float32


def test_the_test_split_has_no_ground_truth(root, cloud):
    source = Completion3D(root, "test")
    example = source[1]
    assert (example.complete, example.category) == (None, "all")
    np.testing.assert_array_equal(example.partial, cloud(21, 300))


def test_the_source_pickles_after_a_read(root):
    source = Completion3D(root, "train")
    first = source[0]
    other = pickle.loads(pickle.dumps(source))[0]
    np.testing.assert_array_equal(first.partial, other.partial)


def test_missing_files_and_lists_are_refused(root):
    (root / "val" / "gt" / "02691156" / "a1.h5").unlink()
    with pytest.raises(
        InputError, match=r"1 of the 4 files .* missing: val/gt/02691156/a1.h5;"
    ):
        Completion3D(root, "val")
    (root / "test.list").unlink()
    with pytest.raises(InputError, match=r"test.list: no such file"):
        Completion3D(root, "test")
    with pytest.raises(InputError, match=r"^split: "):
        Completion3D(root, "valid")


def test_a_damaged_file_is_refused_by_name(root, cloud, write):
    source = Completion3D(root, "train")
    path = root / "train" / "partial" / "02958343" / "b2.h5"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"partial/02958343/b2.h5: cannot be read"):
        source[0]
    write(path, {"points": cloud(0, 300)})
    with pytest.raises(InputError, match=r"no array 'data': it holds points"):
        source[0]
    write(path, {"data": np.full((4, 3), np.nan)})
    with pytest.raises(InputError, match=r"b2.h5: has points that are not finite"):
        source[0]
    write(root / "train" / "gt" / "02691156" / "a1.h5", {"data": cloud(0, 2047)})
    with pytest.raises(InputError, match=r"gt/02691156/a1.h5: holds 2047 points"):
        source[1]
