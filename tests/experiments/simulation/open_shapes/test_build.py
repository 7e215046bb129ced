"""The open shapes on disk, and as a source."""

import json

import numpy as np
import pytest

from experiments.simulation.build_dataset import build_dataset
from experiments.simulation.open_shapes import build, make_open_shape
from experiments.simulation.open_shapes.build import OpenConfig, build_open_shapes
from experiments.simulation.shapes import category_rng
from experiments.simulation.views import views_of
from prism_jax.data.datasets import DATASETS, folder_of, open_dataset, open_training
from prism_jax.io.errors import InputError

CONFIG = OpenConfig(num_shapes=3, num_views=2, shard_shapes=2)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("open")
    build_open_shapes(CONFIG, folder, 0, progress=False)
    return folder


def test_items_are_the_views_of_shape_after_shape(data_dir):
    source = open_dataset("open", "train", data_dir)
    assert source.categories == ("open",)
    assert source.objects.tolist() == [0, 0, 1, 1, 2, 2]
    partials, complete, eyes, *_ = views_of(
        make_open_shape(2), category_rng("open", 2, 1), 2
    )
    for view in range(2):
        example = source[4 + view]
        np.testing.assert_array_equal(example.partial, partials[view])
        np.testing.assert_array_equal(example.complete, complete)
        np.testing.assert_array_equal(example.eye, eyes[view])
        assert example.name == f"000002/{view:02d}"
        assert example.category == "open"
        assert example.ordered and not example.any_heading


def test_two_workers_write_the_same_bytes(data_dir, tmp_path, digests):
    build_open_shapes(CONFIG, tmp_path, 2, progress=False)
    other = digests(folder_of("open", "train", tmp_path))
    assert other == digests(folder_of("open", "train", data_dir))


def test_what_was_broken_off_goes_on(data_dir, tmp_path, digests, monkeypatch):
    made = []

    def one_shard(seed):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(seed)
        return make_open_shape(seed)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(build, "make_open_shape", one_shard)
        build_open_shapes(CONFIG, tmp_path, 0, progress=False)
    with pytest.raises(InputError, match=r"broken off; .* --dataset=open"):
        open_dataset("open", "train", tmp_path)
    build_open_shapes(CONFIG, tmp_path, 0, progress=False)
    assert made == [0, 1]
    whole = folder_of("open", "train", data_dir)
    assert digests(folder_of("open", "train", tmp_path)) == digests(whole)


def test_another_seed_makes_other_shapes(data_dir, tmp_path):
    config = OpenConfig(num_shapes=1, num_views=1, seed=1)
    build_open_shapes(config, tmp_path, 0, progress=False)
    own = open_dataset("open", "train", data_dir)[0]
    other = open_dataset("open", "train", tmp_path)[0]
    assert not np.array_equal(own.complete, other.complete)


def test_other_settings_do_not_go_into_the_same_folder(data_dir, monkeypatch):
    config = OpenConfig(num_shapes=4, num_views=2, shard_shapes=2)
    with pytest.raises(InputError, match=r"other settings \(num_shapes\)"):
        build_open_shapes(config, data_dir, 0, progress=False)
    monkeypatch.setattr(build, "OPEN_VERSION", build.OPEN_VERSION + 1)
    with pytest.raises(InputError, match=r"other settings \(generator_version\)"):
        build_open_shapes(CONFIG, data_dir, 0, progress=False)


@pytest.mark.parametrize(
    ("setting", "fault"),
    [
        ({"num_shapes": 0}, "0 is not within 1"),
        ({"num_views": -1}, "-1 is not within 1"),
        ({"seed": -1}, "-1 is not within 0"),
        ({"split": "test"}, "unknown value 'test'; use train"),
        ({"partial": "lidar"}, "unknown value 'lidar'; use one of self_"),
    ],
)
def test_settings_without_sense_are_named(setting, fault):
    with pytest.raises(InputError, match=f"{next(iter(setting))}: {fault}"):
        OpenConfig(**setting)


def test_by_name_the_defaults_are_those_of_the_configuration(tmp_path, monkeypatch):
    asked = []

    def ask(*given):
        asked.append(given)
        return tmp_path

    monkeypatch.setattr(build, "build_open_shapes", ask)
    build_dataset("open", "train", tmp_path)
    assert asked == [(OpenConfig(), tmp_path, None)]


def test_a_training_holds_some_out(data_dir):
    assert DATASETS["open"].validation is None
    train, validation = open_training("open", data_dir)
    assert (len(train), len(validation)) == (4, 1)


def test_the_manifest_states_the_content(data_dir):
    folder = folder_of("open", "train", data_dir)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["num_shapes"] == 3 and manifest["categories"] == ["open"]
