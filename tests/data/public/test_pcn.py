"""PCN, from a folder in GRNet's layout."""

import pickle

import numpy as np
import pytest

from prism_jax.data.public.pcn import PCN
from prism_jax.io import InputError

SPLITS = ("train", "val", "test")
MODELS = {"02691156": "airplane", "02958343": "car"}


@pytest.fixture
def root(tmp_path, cloud, write):
    """One airplane and one car a split; car number 1 is the second model."""
    for split in SPLITS:
        for seed, synset in enumerate(MODELS):
            path = tmp_path / split / "complete" / synset / f"{split}{seed}.pcd"
            write(path, cloud(seed, 16384))
            for view in range(8 if split == "train" else 1):
                folder = tmp_path / split / "partial" / synset / f"{split}{seed}"
                write(folder / f"{view:02d}.pcd", cloud(10 + view, 20 + seed))
    entries = [
        {"taxonomy_id": synset, "taxonomy_name": name}
        | {split: [f"{split}{seed}"] for split in SPLITS}
        for seed, (synset, name) in enumerate(MODELS.items())
    ]
    write(tmp_path / "PCN.json", entries)
    return tmp_path


@pytest.mark.parametrize(("split", "views"), [("train", 8), ("val", 1), ("test", 1)])
def test_every_view_of_every_model_is_one_item(root, cloud, split, views):
    source = pickle.loads(pickle.dumps(PCN(root, split)))
    assert source.categories == ("airplane", "car")
    assert len(source) == 2 * views
    example = source[2 * views - 1]
    np.testing.assert_array_equal(example.complete, cloud(1, 16384))
    np.testing.assert_array_equal(example.partial, cloud(10 + views - 1, 21))
    assert (example.category, example.eye) == ("car", None)
    assert example.name == f"02958343/{split}1/{views - 1:02d}"
    assert len({item.name for item in source}) == 2 * views


def test_missing_files_and_unknown_splits_are_refused(root, write):
    (root / "train" / "partial" / "02691156" / "train0" / "03.pcd").unlink()
    (root / "train" / "complete" / "02958343" / "train1.pcd").unlink()
    with pytest.raises(InputError) as error:
        PCN(root, "train")
    assert (
        "2 of the 18 files in PCN.json are missing: "
        "train/complete/02958343/train1.pcd, train/partial/02691156/train0/03.pcd; "
    ) in str(error.value)
    with pytest.raises(InputError, match=r"ShapeNet.json: no such file"):
        PCN(root, "train", list_file="ShapeNet.json")
    with pytest.raises(InputError, match="use one of train, val, test"):
        PCN(root, "valid")
    write(root / "test" / "partial" / "02691156" / "test0" / "00.pcd", np.ones((0, 3)))
    with pytest.raises(InputError, match=r"test0/00.pcd: "):
        PCN(root, "test")[0]
