"""Data sets by name, and what is held out of a training."""

import numpy as np
import pytest

from experiments.assets import CELLS
from experiments.simulation import build_dataset as building_by_name
from experiments.simulation.build_dataset import build_dataset, build_if_missing
from experiments.simulation.building import write_manifest
from experiments.simulation.recorder import write_frame
from experiments.simulation.shapes import build as shapes_build
from prism_jax.data import datasets
from prism_jax.data.datasets import (
    DATASETS,
    GENERATED,
    digest_of,
    open_dataset,
    open_training,
    scored_splits,
)
from prism_jax.data.recordings import RecordedFrame
from prism_jax.data.shards import Shards
from prism_jax.data.source import Source
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError
from tests.data.test_holdout import Views, names


def test_shapes_are_built_and_opened(tmp_path):
    folder = build_dataset("shapes", "validation", tmp_path, 0, num_shapes=1, seed=5)
    assert folder == tmp_path / "shapes-validation"
    # Which would take the 396 shapes of the defaults, were it not there.
    build_if_missing("shapes", "validation", tmp_path)
    source = open_dataset("shapes", "validation", tmp_path)
    assert isinstance(source, Shards)
    assert names(source) == ["000000/00"]


def test_what_was_broken_off_goes_on(tmp_path, monkeypatch):
    whole = build_dataset("shapes", "validation", tmp_path / "a", 0, num_shapes=2)

    def broken(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shapes_build, "make_views", broken)
        build_if_missing("shapes", "validation", tmp_path, num_workers=0, num_shapes=2)
    build_if_missing("shapes", "validation", tmp_path, num_workers=0, num_shapes=2)
    place = ("shapes", "validation", tmp_path)
    assert names(open_dataset(*place)) == ["000000/00", "000001/00"]
    # The same files as of an unbroken build, and others than of another seed.
    digest = digest_of("shapes", "validation", whole.parent)
    assert digest == digest_of(*place) and len(digest) == 12
    build_dataset("shapes", "validation", tmp_path / "b", 0, num_shapes=2, seed=1)
    assert digest_of("shapes", "validation", tmp_path / "b") not in (None, digest)
    assert digest_of("shapes", "test", tmp_path) is None


@pytest.mark.parametrize("name", GENERATED)
def test_a_place_where_nothing_can_be_built(name, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file"):
        build_if_missing(name, "train", tmp_path / "file")


@pytest.mark.parametrize("name", GENERATED)
def test_what_another_version_built_is_refused(name, tmp_path):
    folder = tmp_path / f"{name}-train"
    folder.mkdir()
    write_manifest(folder, {"generator_version": 0, "files": {}})
    with pytest.raises(InputError, match=f"another version.*--dataset={name}"):
        open_dataset(name, "train", tmp_path)


def test_recordings_have_one_split():
    root = CELLS
    assert len(open_dataset("recordings", "all", root)) == 12
    with pytest.raises(InputError, match="unknown value 'test'; use all"):
        open_dataset("recordings", "test", root)
    assert digest_of("recordings", "all", root) is not None


def test_splits_that_can_be_scored():
    assert scored_splits("shapes") == ("validation", "test", "unseen", "novel")
    assert scored_splits("roboarm") == ("validation", "test")
    assert scored_splits("pcn") == ("val", "test")
    assert scored_splits("shapenet55") == ("test",)
    assert scored_splits("packed") == ("validation",)
    for name in ("recordings", "kitti", "open"):
        with pytest.raises(
            InputError, match=f"{name}: no held-out split with ground truth"
        ):
            scored_splits(name)


def test_what_is_missing_is_built_with_its_defaults(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        building_by_name, "build_dataset", lambda *place: asked.append(place)
    )
    for name in ("shapes", "roboarm", "pcn"):
        build_if_missing(name, "validation", tmp_path)
    assert asked == [(name, "validation", tmp_path) for name in ("shapes", "roboarm")]


def test_a_set_with_a_validation_split_trains_on_all_of_its_training_split(shapes_dir):
    train, validation = open_training("shapes", shapes_dir)
    assert train.objects.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    whole = open_dataset("shapes", "validation", shapes_dir)
    assert names(validation) == names(whole)
    assert len(open_training("shapes", shapes_dir, 2)[1]) == 2


@pytest.fixture
def opened(monkeypatch):
    """What `open_training` opens."""
    found = []

    def open_any(*arguments):
        found.append(arguments)
        return Views(40, 2)

    monkeypatch.setattr(datasets, "open_dataset", open_any)
    return found


@pytest.mark.parametrize(
    ("name", "split"), [("shapenet55", "train"), ("recordings", "all")]
)
def test_of_another_some_objects_are_held_out(opened, name, split):
    train, validation = open_training(name, "folder")
    assert (len(train), len(validation)) == (72, 4)
    assert opened == [(name, split, "folder")]


def test_pcn_is_validated_on_its_own_split(opened):
    train, validation = open_training("pcn", "folder", 7)
    assert (len(train), len(validation)) == (80, 7)
    assert opened == [("pcn", "train", "folder"), ("pcn", "val", "folder")]


@pytest.mark.parametrize(
    ("lengths", "sizes"), [((2, 2, 2), (4, 1)), ((3, 1), (1, 1)), ((1, 3, 2), (3, 1))]
)
def test_frames_of_a_sequence_stay_on_one_side(tmp_path, lengths, sizes):
    points = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    camera = Camera.look_at(np.array([3.0, 0, 1]), np.zeros(3))
    depth = np.ones((camera.height, camera.width), np.uint16)
    for sequence, length in enumerate(lengths):
        for number in range(length):
            frame = RecordedFrame(depth, camera, points, points)
            write_frame(tmp_path / f"{sequence:03d}", number, frame)
    source = open_dataset("recordings", "all", tmp_path)
    assert isinstance(source, Source)
    numbers = np.repeat(np.arange(len(lengths)), lengths)
    np.testing.assert_array_equal(source.objects, numbers)
    train, validation = open_training("recordings", tmp_path)
    assert (len(train), len(validation)) == sizes
    sequences = {name.split("/")[0] for name in names(train)}
    assert names(validation)[0].split("/")[0] not in sequences


@pytest.mark.parametrize(
    "name", ["kitti", "shapenet_unseen21", "projected_shapenet_unseen21"]
)
def test_sets_without_a_training_split_are_refused(name, tmp_path):
    with pytest.raises(InputError, match="no training split"):
        open_training(name, tmp_path)


def test_what_there_is_not_is_refused(tmp_path):
    with pytest.raises(InputError, match="unknown value 'shapez'; use one of shapes"):
        open_dataset("shapez", "train")
    with pytest.raises(InputError, match="unknown value 'pcn'; use one of shapes"):
        build_dataset("pcn", "train", tmp_path)
    for name in sorted({*DATASETS} - {*GENERATED}):
        with pytest.raises(InputError, match="set --data_dir to its folder"):
            open_dataset(name, "train")


@pytest.mark.parametrize("name", DATASETS)
def test_an_empty_folder_is_none_of_them(name, tmp_path):
    with pytest.raises(InputError):
        open_dataset(name, "train", tmp_path)
