import dataclasses
import hashlib
import json

import numpy as np
import pytest

from prism_jax.data import corpus
from prism_jax.data.corpus import (
    SPLITS,
    CorpusConfig,
    build_corpus,
    load_corpus,
    shape_seed,
    split_dir,
)
from prism_jax.data.shapes import CATEGORIES
from prism_jax.io.errors import InputError


def digests(folder):
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.iterdir()
    }


def test_loaded_examples_have_the_contract(small_config, small_corpus):
    examples = load_corpus("train", small_config, small_corpus)
    assert examples.partial.shape == (10, 2048, 3)
    assert examples.complete.shape == (10, 512, 3)
    assert examples.categories == CATEGORIES
    np.testing.assert_array_equal(examples.category, np.arange(10))
    assert len({partial.tobytes() for partial in examples.partial}) == 10


def test_limit_reads_a_prefix(small_config, small_corpus):
    whole = load_corpus("train", small_config, small_corpus)
    prefix = load_corpus("train", small_config, small_corpus, limit=5)
    np.testing.assert_array_equal(prefix.complete, whole.complete[:5])
    assert len(prefix.category) == 5


def test_bytes_do_not_depend_on_the_number_of_workers(tmp_path):
    config = CorpusConfig(validation_examples=2, shard_examples=1)
    folders = [
        build_corpus("validation", config, tmp_path / str(count), count, progress=False)
        for count in (0, 2)
    ]
    assert len(digests(folders[0])) == 3
    assert digests(folders[0]) == digests(folders[1])


def test_a_second_build_changes_nothing(small_config, small_corpus, monkeypatch):
    folder = split_dir("train", small_config, small_corpus)
    before = digests(folder)
    monkeypatch.setattr(corpus, "make_example", None)
    build_corpus("train", small_config, small_corpus, 0, progress=False)
    assert digests(folder) == before


def test_interrupted_build_leaves_whole_shards_and_resumes(
    small_config, small_corpus, tmp_path, monkeypatch
):
    make, calls = corpus.make_example, []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 7:
            raise KeyboardInterrupt
        return make(*arguments)

    monkeypatch.setattr(corpus, "make_example", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build_corpus("train", small_config, tmp_path, 0, progress=False)
    folder = split_dir("train", small_config, tmp_path)
    assert [path.name for path in folder.iterdir()] == ["shard-00000.npz"]
    with pytest.raises(InputError, match="not built"):
        load_corpus("train", small_config, tmp_path)
    monkeypatch.setattr(corpus, "make_example", make)
    build_corpus("train", small_config, tmp_path, 0, progress=False)
    whole = split_dir("train", small_config, small_corpus)
    assert digests(folder) == digests(whole)


def test_failed_write_leaves_no_half_shard(tmp_path, monkeypatch):
    config = CorpusConfig(test_examples=1)

    def full_disk(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(InputError, match="No space left"):
        build_corpus("test", config, tmp_path, 0, progress=False)
    assert list(split_dir("test", config, tmp_path).iterdir()) == []


def test_shape_seeds_of_splits_and_corpora_are_disjoint():
    configs = [CorpusConfig(seed=seed) for seed in (0, 1, 2)]
    seeds = [
        shape_seed(config, split, index)
        for config in configs
        for split in SPLITS
        for index in (*range(500), 23999, 2**32 - 1)
    ]
    assert len(set(seeds)) == len(seeds)


def test_damaged_missing_and_foreign_files_are_named(
    small_config, small_corpus, tmp_path
):
    source = split_dir("train", small_config, small_corpus)
    folder = split_dir("train", small_config, tmp_path)
    folder.mkdir()
    for path in source.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    shard = folder / "shard-00001.npz"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    with pytest.raises(InputError, match=r"shard-00001\.npz: differs"):
        load_corpus("train", small_config, tmp_path)
    shard.unlink()
    with pytest.raises(InputError, match=r"shard-00001\.npz: cannot be read"):
        load_corpus("train", small_config, tmp_path)
    (folder / "manifest.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        load_corpus("train", small_config, tmp_path)
    with pytest.raises(InputError, match="unknown split 'dev'"):
        load_corpus("dev", small_config, tmp_path)


@pytest.mark.parametrize(
    "setting",
    [{"shard_examples": 0}, {"seed": -1}, {"train_complete_points": 16385}],
)
def test_settings_without_sense_are_named(setting):
    with pytest.raises(InputError, match=f"{next(iter(setting))}: .* is not within"):
        CorpusConfig(**setting)


def test_limit_must_be_positive(small_config, small_corpus):
    with pytest.raises(InputError, match="limit: 0 is not positive"):
        load_corpus("train", small_config, small_corpus, limit=0)


def test_manifest_states_the_content(small_config, small_corpus):
    folder = split_dir("train", small_config, small_corpus)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["examples"] == 10
    assert manifest["complete_points"] == 512
    assert {e["file"]: e["sha256"] for e in manifest["shards"]} == {
        name: digest for name, digest in digests(folder).items() if "shard" in name
    }


def test_every_setting_that_changes_content_changes_the_folder(small_config):
    changes = {
        "train_examples": 11,
        "train_complete_points": 256,
        "seed": 1,
        "shard_examples": 5,
    }
    folders = {
        split_dir("train", dataclasses.replace(small_config, **{name: value}), ".")
        for name, value in changes.items()
    }
    folders.add(split_dir("train", small_config, "."))
    assert len(folders) == len(changes) + 1
