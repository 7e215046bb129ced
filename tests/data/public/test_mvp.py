"""MVP, from files in the layouts of VRCNet and of the challenge."""

import pickle

import h5py
import numpy as np
import pytest

from prism_jax.data.public.mvp import MVP
from prism_jax.io import InputError


def clouds(rng, models, points):
    return rng.normal(size=(models, points, 3)).astype(np.float32)


def part(rng, models, categories, points, prefix=""):
    """Arrays of one part: inputs and truths."""
    inputs = {
        f"{prefix}incomplete_pcds": clouds(rng, 26 * models, 32),
        f"{prefix}labels": np.repeat(categories, 26),
    }
    return inputs, {f"{prefix}complete_pcds": clouds(rng, models, points)}


@pytest.fixture
def release(tmp_path, write):
    """Writes VRCNet's layout; gives all arrays."""

    def make(split, num_points):
        rng = np.random.default_rng(num_points)
        seen, novel = (
            part(rng, 2, [0, 7], num_points),
            part(rng, 1, [15], num_points, "novel_"),
        )
        write(tmp_path / f"mvp_{split}_input.h5", seen[0] | novel[0])
        write(tmp_path / f"mvp_{split}_gt_{num_points}pts.h5", seen[1] | novel[1])
        return seen[0] | novel[0] | seen[1] | novel[1]

    return make


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("num_points", [2048, 4096, 8192, 16384])
def test_vrcnets_release_has_26_views_a_model(release, tmp_path, split, num_points):
    arrays = release(split, num_points)
    source = MVP(tmp_path, split, num_points)
    assert len(source) == 3 * 26
    example = source[26 + 4]
    np.testing.assert_array_equal(example.partial, arrays["incomplete_pcds"][30])
    np.testing.assert_array_equal(example.complete, arrays["complete_pcds"][1])
    assert (example.category, example.name) == ("watercraft", "0001/04")
    example = source[-1]
    np.testing.assert_array_equal(example.partial, arrays["novel_incomplete_pcds"][25])
    np.testing.assert_array_equal(example.complete, arrays["novel_complete_pcds"][0])
    assert (example.category, example.name) == ("skateboard", "novel_0000/25")
    assert example.complete.shape == (num_points, 3)
    assert example.eye is None
    with pytest.raises(IndexError):
        source[78]


@pytest.mark.parametrize(
    ("split", "name"), [("train", "MVP_Train_CP.h5"), ("test", "MVP_Test_CP.h5")]
)
def test_the_challenges_release_is_one_file(tmp_path, write, split, name):
    inputs, truths = part(np.random.default_rng(0), 2, [3, 8], 2048)
    write(tmp_path / name, inputs | truths)
    source = MVP(tmp_path, split)
    assert (len(source), len(source.categories)) == (52, 16)
    np.testing.assert_array_equal(source[27].partial, inputs["incomplete_pcds"][27])
    np.testing.assert_array_equal(source[27].complete, truths["complete_pcds"][1])
    assert [source[i].category for i in (25, 26)] == ["chair", "bed"]
    assert len({example.name for example in source}) == 52


def test_the_source_pickles_after_a_read(release, tmp_path):
    release("test", 2048)
    source = MVP(tmp_path, "test")
    first = source[60]
    other = pickle.loads(pickle.dumps(source))[60]
    np.testing.assert_array_equal(first.partial, other.partial)
    assert first.name == other.name


def test_a_missing_file_or_resolution_is_refused(release, tmp_path):
    release("train", 4096)
    with pytest.raises(
        InputError, match=r"1 of the 2 files .* missing: mvp_train_gt_8192pts.h5;"
    ):
        MVP(tmp_path, "train", 8192)
    with pytest.raises(InputError, match=r"or MVP_Test_CP.h5"):
        MVP(tmp_path, "test")
    with pytest.raises(InputError, match=r"^num_points: unknown value '1024'; use"):
        MVP(tmp_path, "train", 1024)
    with pytest.raises(InputError, match=r"^split: "):
        MVP(tmp_path, "val")


def test_arrays_that_do_not_fit_each_other_are_refused(tmp_path, write):
    inputs, truths = part(np.random.default_rng(0), 2, [3, 8], 2048)
    path = tmp_path / "MVP_Test_CP.h5"
    for changed in (
        {"complete_pcds": truths["complete_pcds"][:1]},
        {"complete_pcds": truths["complete_pcds"][:, :-1]},
        {"incomplete_pcds": inputs["incomplete_pcds"][..., :2]},
        {"incomplete_pcds": inputs["incomplete_pcds"][0]},
        {"complete_pcds": np.float32(0)},
        {"labels": inputs["labels"][:-1]},
    ):
        write(path, inputs | truths | changed)
        with pytest.raises(InputError, match=r"CP.h5: incomplete_pcds .* do not fit"):
            MVP(tmp_path, "test")


def test_labels_and_files_that_are_damaged_are_refused(tmp_path, write):
    inputs, truths = part(np.random.default_rng(0), 2, [3, 16], 2048)
    path = write(tmp_path / "MVP_Test_CP.h5", inputs | truths)
    with pytest.raises(InputError, match="labels outside 0 to 15"):
        MVP(tmp_path, "test")
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(InputError, match=r"CP.h5: cannot be read as HDF5"):
        MVP(tmp_path, "test")


def test_a_damaged_cloud_is_refused_by_file_and_name(tmp_path, write):
    inputs, truths = part(np.random.default_rng(0), 1, [3], 2048)
    inputs["incomplete_pcds"][25, 3] = np.nan
    path = write(tmp_path / "MVP_Train_CP.h5", inputs | truths)
    source = MVP(tmp_path, "train")
    assert source[24].name == "0000/24"
    with pytest.raises(InputError, match=r"CP.h5 \(0000/25\): .* not finite"):
        source[25]
    assert h5py.is_hdf5(path)
