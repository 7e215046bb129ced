"""Weights on disk."""

import dataclasses
import functools
import itertools
import json
import operator
import pathlib
import pickle
import re

import pytest
import safetensors.numpy

from experiments import weights
from experiments.baselines.weights import load_network
from experiments.presets import PRESETS
from prism_jax.adaptation.config import PrismConfig
from prism_jax.assets import asset
from prism_jax.completion.weights import (
    RETIRED,
    available_weights,
    config_from_dict,
    load_calibration,
    load_pretrained,
    read_metadata,
    save_weights,
)
from prism_jax.io.errors import InputError
from tests.io.test_arrays import Bomb
from tests.trees import bitwise

METADATA = {"seed": 3, "scores": {"cd_l2": [1.5, 2.0]}, "commit": None}


@pytest.fixture(scope="module")
def file(tmp_path_factory, minimal, minimal_variables):
    path = tmp_path_factory.mktemp("weights") / "minimal.safetensors"
    save_weights(path, minimal.config, minimal_variables, METADATA)
    return path


@pytest.fixture
def rewritten(file, tmp_path):
    """``rewritten(change)``: the file after a change of its arrays and metadata."""

    def rewrite(change):
        with safetensors.safe_open(file, framework="numpy") as opened:
            metadata = dict(opened.metadata())
        arrays = safetensors.numpy.load_file(file)
        change(arrays, metadata)
        path = tmp_path / "changed.safetensors"
        safetensors.numpy.save_file(arrays, path, metadata or None)
        return str(path)

    return rewrite


def fault(path):
    with pytest.raises(InputError) as caught:
        load_pretrained(path)
    return str(caught.value)


def test_round_trip_is_bitwise(file, minimal, minimal_variables):
    config, variables = load_pretrained(str(file))
    assert config == minimal.config
    assert hash(config) == hash(minimal.config)
    assert bitwise(variables, minimal_variables)
    metadata = read_metadata(str(file))
    assert {key: metadata[key] for key in METADATA} == METADATA
    assert metadata["config"]["model"]["backbone"]["num_points"] == 64


def test_names_of_what_ships():
    assert available_weights() == ["small"]
    config, variables = load_pretrained("small")
    assert config.model.backbone.stage_sizes[-1] >= 2048
    # Given as a file, the same weights are compared with their configuration.
    _, checked = load_pretrained(str(asset("small.safetensors")))
    assert bitwise(variables, checked)
    for path in pathlib.Path(weights.__file__).parent.glob("*.safetensors"):
        ours = "network" not in read_metadata(str(path))
        (load_pretrained if ours else load_network)(str(path))


@pytest.mark.parametrize("name", ["no_such_weights", "."])
def test_an_unknown_name(name):
    wanted = f"{name}: no such weights; give a .safetensors file"
    assert fault(name).startswith(wanted)


def test_a_file_that_is_cut_short_or_nonsense(file, tmp_path):
    path, whole = tmp_path / "broken.safetensors", file.read_bytes()
    header = b'{"a":{"dtype":"F8_E5M2","shape":[1],"data_offsets":[0,1]}}'
    of_no_array = len(header).to_bytes(8, "little") + header + bytes(1)
    nonsense = b"\xff" * 64 + whole[64:]
    for content in (b"", whole[:7], whole[:1000], whole[:-1], nonsense, of_no_array):
        path.write_bytes(content)
        assert "not readable as weights" in fault(str(path))
        with pytest.raises(InputError, match="not readable as weights"):
            read_metadata(str(path))


def test_a_pickle_is_refused_and_never_run(tmp_path):
    path = tmp_path / "weights.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    assert "not readable as weights" in fault(str(path))


def test_a_configuration_that_is_none(rewritten):
    for text in (
        "{",
        "[]",
        "{}",
        '{"model": {"backbone": [], "auxiliary": {}}}',
        '{"model": {"backbone": {"unknown": 1}, "auxiliary": {}}}',
        '{"model": {"backbone": {}, "auxiliary": {}}, "adapt": {}, "seed": 1}',
        "[" * 100_000,
        '{"model": 1' + "0" * 5000 + "}",
        f'{{"model": {"[" * 400}{"]" * 400}}}',
    ):
        path = rewritten(lambda arrays, about, text=text: about.update(config=text))
        assert re.search("not (readable as|weights)", fault(path)), text[:80]
    theirs = {"calibration": json.dumps(read_metadata("small")["calibration"])}
    with pytest.raises(InputError, match=r"changed.* 256 features, not"):
        load_calibration(rewritten(lambda arrays, about: about.update(theirs)))
    path = rewritten(lambda arrays, metadata: metadata.clear())
    assert "not weights of prism_jax: missing 'config'" in fault(path)


def settings(fields, path=()):
    """The path of every setting in a configuration's fields."""
    for name, value in fields.items():
        if isinstance(value, dict):
            yield from settings(value, (*path, name))
        else:
            yield (*path, name)


SETTINGS = list(settings(dataclasses.asdict(PRESETS["tiny"].config)))


@pytest.fixture
def crafted(tiny, tmp_path):
    """``crafted(path, value)``: the fault of weights with one setting changed."""

    def craft(path, value):
        fields = json.loads(json.dumps(dataclasses.asdict(tiny)))
        functools.reduce(operator.getitem, path[:-1], fields)[path[-1]] = value
        file = tmp_path / "crafted.safetensors"
        safetensors.numpy.save_file({}, file, {"config": json.dumps(fields)})
        return fault(str(file))

    return craft


def test_a_setting_out_of_its_range_is_refused(crafted):
    others = itertools.cycle([-(10**400), float("nan"), "4", None, [[]]])
    for path, other in zip(SETTINGS, others, strict=False):
        for value in (-(10**9), other):
            assert "not weights of prism_jax: " in crafted(path, value), path


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("backbone/num_points", 0, "num_points must be an integer from 1 to 65536"),
        ("backbone/features", 32, "not weights of prism_jax: add got incompatible"),
        ("backbone/up_factors", [256, 256], "must not have over 262,144 points"),
    ],
)
def test_settings_that_do_not_fit_are_refused(crafted, path, value, told):
    assert told in crafted(("model", *path.split("/")), value)


@pytest.mark.parametrize("name", RETIRED)
def test_a_retired_field_loads_at_its_neutral_value_alone(tiny, name):
    fields = json.loads(json.dumps(dataclasses.asdict(tiny)))
    assert config_from_dict(fields) == tiny and isinstance(tiny, PrismConfig)
    *path, field = name.split(".")
    part = functools.reduce(operator.getitem, path, fields)
    part[field] = RETIRED[name]
    assert config_from_dict(fields) == tiny
    part[field] = 1.0
    with pytest.raises(ValueError, match=f"{name}=1.0 is no longer supported"):
        config_from_dict(fields)


KERNEL, MORE = "params/refiner/g/dense_0/kernel", "params/refiner/more"


@pytest.mark.parametrize(
    ("name", "array", "told"),
    [
        (KERNEL, None, f"{KERNEL}: missing or wrong shape"),
        (KERNEL, lambda array: array[:-1], f"{KERNEL}: missing or wrong shape"),
        (MORE, lambda array: array, f"unknown array {MORE}"),
    ],
)
def test_arrays_that_are_not_the_configurations_are_refused(
    rewritten, name, array, told
):
    def change(arrays, metadata):
        kernel = arrays.pop(name, arrays[KERNEL])
        if array is not None:
            arrays[name] = array(kernel)

    assert told in fault(rewritten(change))


def test_a_failed_write_leaves_what_was_there(file, tmp_path, minimal, minimal_fresh):
    path = tmp_path / "kept.safetensors"
    path.write_bytes(file.read_bytes())
    with pytest.raises(TypeError):
        save_weights(path, minimal.config, minimal_fresh, {"scores": object()})
    assert path.read_bytes() == file.read_bytes()
    with pytest.raises(InputError, match="cannot be written"):
        save_weights(tmp_path / "no" / "such.safetensors", minimal.config, {}, {})
