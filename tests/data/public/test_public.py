"""Public sets by name."""

import inspect

import pytest

from prism_jax.data.datasets import DATASETS, open_dataset
from prism_jax.data.public.shapenet import SYNSETS
from prism_jax.io import InputError

PUBLIC = [name for name, known in DATASETS.items() if known.folder is None]


@pytest.mark.parametrize("name", PUBLIC)
def test_every_set_refuses_an_empty_folder_with_one_line(tmp_path, name):
    with pytest.raises(InputError, match=f"^{tmp_path}") as error:
        open_dataset(name, "test", tmp_path)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("name", PUBLIC)
def test_every_loader_takes_root_and_split_first(name):
    parameters = inspect.signature(DATASETS[name].open).parameters
    assert list(parameters)[:2] == ["root", "split"]


def test_options_reach_the_loader(tmp_path, cloud, write):
    write(tmp_path / "ShapeNet-34" / "test.txt", "02691156-a.npy\n")
    write(tmp_path / "shapenet_pc" / "02691156-a.npy", cloud(0, 8192))
    assert len(open_dataset("shapenet34", "test", tmp_path)) == 1
    assert len(open_dataset("shapenet34", "test", tmp_path, difficulty="easy")) == 8


def test_an_unknown_set_or_option_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"^data set: unknown value 'scannet'; use "):
        open_dataset("scannet", "test", tmp_path)
    with pytest.raises(
        InputError, match=r"^num_points: not an option of pcn; .*list_f"
    ):
        open_dataset("pcn", "test", tmp_path, num_points=2048)
    with pytest.raises(InputError, match=r"^subset: not an option of shapenet55"):
        open_dataset("shapenet55", "test", tmp_path, subset="ShapeNet-34")


def test_there_are_55_categories_of_distinct_names():
    assert len(SYNSETS) == len(set(SYNSETS.values())) == 55
    assert list(SYNSETS) == sorted(SYNSETS)
