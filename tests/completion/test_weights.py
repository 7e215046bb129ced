"""Weights on disk."""

import dataclasses
import json
import pathlib
import pickle

import jax
import numpy as np
import pytest
import safetensors.numpy

from experiments import weights
from experiments.baselines.weights import load_network
from prism_jax.adaptation.config import PrismConfig
from prism_jax.assets import asset
from prism_jax.completion.weights import (
    RETIRED,
    available_weights,
    config_from_dict,
    load_pretrained,
    read_metadata,
    samples_seen,
    save_weights,
    trainings,
)
from prism_jax.io.errors import InputError
from prism_jax.training.presets import PRESETS

METADATA = {"seed": 3, "scores": {"cd_l2": [1.5, 2.0]}, "commit": None}


@pytest.fixture(scope="module")
def file(tmp_path_factory, tiny, tiny_variables):
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(path, tiny, tiny_variables, METADATA)
    return path


@pytest.fixture
def rewritten(file, tmp_path):
    """``rewritten(change)``: the file after a change of its arrays and metadata."""

    def rewrite(change):
        with safetensors.safe_open(file, framework="numpy") as opened:
            metadata = dict(opened.metadata())
            arrays = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
        change(arrays, metadata)
        path = tmp_path / "changed.safetensors"
        safetensors.numpy.save_file(arrays, path, metadata or None)
        return str(path)

    return rewrite


def fault(path):
    with pytest.raises(InputError) as caught:
        load_pretrained(path)
    assert str(caught.value).count("\n") == 0
    assert "Traceback" not in str(caught.value)
    return str(caught.value)


def test_round_trip_is_bitwise(file, tiny, tiny_variables):
    config, variables = load_pretrained(str(file))
    assert config == tiny
    assert hash(config) == hash(tiny)
    assert jax.tree.structure(variables) == jax.tree.structure(tiny_variables)
    leaves = jax.tree.leaves(variables), jax.tree.leaves(tiny_variables)
    for a, b in zip(*leaves, strict=True):
        assert a.dtype == b.dtype
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_metadata(file):
    metadata = read_metadata(str(file))
    assert {key: metadata[key] for key in METADATA} == METADATA
    assert metadata["config"]["model"]["backbone"]["num_points"] == 64


def test_samples_of_all_trainings():
    first = {"data": "shapes", "samples": 200}
    last = {"samples": 30, "pretrained": {"samples": 4, "pretrained": first}}
    assert [run["samples"] for run in trainings(last)] == [200, 4, 30]
    assert samples_seen(last) == 234
    assert samples_seen({}) == 0


@pytest.mark.parametrize("name", PRESETS)
def test_a_configuration_survives_json(name):
    config = PRESETS[name].config
    fields = json.loads(json.dumps(dataclasses.asdict(config)))
    assert config_from_dict(fields) == config
    assert isinstance(config_from_dict(fields), PrismConfig)


def test_names_of_what_ships():
    names = available_weights()
    assert names == ["small"]
    for name in names:
        config, variables = load_pretrained(name)
        assert config.model.backbone.stage_sizes[-1] >= 2048
        # Given as a file, the same weights are compared with their configuration.
        file = asset(f"{name}.safetensors")
        _, checked = load_pretrained(str(file))
        assert jax.tree.structure(variables) == jax.tree.structure(checked)
        for a, b in zip(*map(jax.tree.leaves, (variables, checked)), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", ["no_such_weights", "/no/such/file.safetensors", "."])
def test_an_unknown_name(name):
    message = fault(name)
    assert message.startswith(f"{name}: no such weights; give a .safetensors file")


@pytest.mark.parametrize("kept", [0, 7, 1000, -1])
def test_a_file_cut_short(file, tmp_path, kept):
    path = tmp_path / "cut.safetensors"
    path.write_bytes(file.read_bytes()[:kept])
    assert "not readable as weights" in fault(str(path))
    with pytest.raises(InputError, match="not readable as weights"):
        read_metadata(str(path))


def test_a_header_of_nonsense(file, tmp_path):
    path = tmp_path / "nonsense.safetensors"
    path.write_bytes(b"\xff" * 64 + file.read_bytes()[64:])
    assert "not readable as weights" in fault(str(path))


def test_a_pickle_is_refused_and_never_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    path = tmp_path / "weights.safetensors"
    path.write_bytes(pickle.dumps(Trap()))
    assert "not readable as weights" in fault(str(path))
    assert not (tmp_path / "sprung").exists()


def test_no_metadata(rewritten):
    path = rewritten(lambda arrays, metadata: metadata.clear())
    assert "no prism_jax configuration in this file" in fault(path)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "3",
        "null",
        "{}",
        '{"model": {}}',
        '{"model": 3}',
        '{"model": {"backbone": [], "auxiliary": {}}}',
        '{"model": {"backbone": {"unknown": 1}, "auxiliary": {}}}',
        '{"model": {"backbone": {}, "auxiliary": {}}, "unknown": 1}',
        '{"model": {"backbone": {}, "auxiliary": {}}, "adapt": 3}',
        '{"model": {"backbone": {}, "auxiliary": {}}, "adapt": {"model": {}}}',
        '{"model": {"backbone": {}, "auxiliary": {}}, "adapt": {}, "seed": 1}',
    ],
)
def test_a_configuration_that_is_none(rewritten, text):
    path = rewritten(lambda arrays, metadata: metadata.update(config=text))
    assert "no prism_jax configuration in this file" in fault(path)


def settings(fields, path=()):
    """The path of every setting in a configuration's fields."""
    for name, value in fields.items():
        if isinstance(value, dict):
            yield from settings(value, (*path, name))
        else:
            yield (*path, name)


SETTINGS = list(settings(dataclasses.asdict(PRESETS["tiny"].config)))
NEVER = [
    -(10**9),
    10**30,
    -(10**400),
    float("nan"),
    "4",
    None,
    {},
    [],
    [[]],
    [1] * 99,
    [{}],
]


@pytest.fixture
def crafted(tiny, tmp_path):
    """``crafted(path, value)``: the fault of weights with one setting changed."""

    def craft(path, value):
        fields = json.loads(json.dumps(dataclasses.asdict(tiny)))
        part = fields
        for name in path[:-1]:
            part = part[name]
        assert path[-1] in part
        part[path[-1]] = value
        file = tmp_path / "crafted.safetensors"
        safetensors.numpy.save_file({}, file, {"config": json.dumps(fields)})
        return fault(str(file))

    return craft


@pytest.mark.parametrize("path", SETTINGS, ids="/".join)
def test_a_setting_out_of_its_range_is_refused(crafted, path):
    for value in NEVER:
        told = crafted(path, value)
        assert "invalid configuration" in told or "no prism" in told


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("backbone/num_points", 0, "num_points must be an integer from 1 to 65536"),
        (
            "backbone/features",
            32,
            "makes no valid network (add got incompatible shapes",
        ),
        ("backbone/num_neighbors", [4], "makes no valid network (tuple index"),
        ("backbone/level_rates", [[1, 2]], "makes no valid network (zip()"),
        (
            "backbone/up_factors",
            [256, 256],
            "a stage must not have over 262,144 points",
        ),
        ("backbone/encoder_rates", [1, 256], "makes no valid network (a search needs"),
        ("auxiliary/depth_blocks", 10**6, "depth_blocks must be an integer from 1"),
        ("auxiliary/depth_features", [4] * 9, "depth_features must be a tuple of 1 to"),
    ],
)
def test_settings_that_do_not_fit_are_refused(crafted, path, value, told):
    assert told in crafted(("model", *path.split("/")), value)


COMPARED = pathlib.Path(weights.__file__).parent
SHIPPED = [p for place in (asset(""), COMPARED) for p in place.glob("*.safetensors")]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_file_loads(path):
    if "network" in read_metadata(str(path)):
        module, variables = load_network(str(path))
        assert module and variables
    else:
        load_pretrained(str(path))


@pytest.mark.parametrize("name", RETIRED)
def test_a_retired_field_loads_at_its_neutral_value_alone(tiny, name):
    fields = json.loads(json.dumps(dataclasses.asdict(tiny)))
    *path, field = name.split(".")
    part = fields
    for step in path:
        part = part[step]
    part[field] = RETIRED[name]
    assert config_from_dict(fields) == tiny
    part[field] = 1.0
    with pytest.raises(ValueError, match=f"{name}=1.0 is no longer supported"):
        config_from_dict(fields)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"model": 1' + "0" * 5000 + "}"])
def test_metadata_that_json_cannot_read(rewritten, text):
    path = rewritten(lambda arrays, metadata: metadata.update(config=text))
    assert "no prism_jax configuration in this file" in fault(path)


def test_an_array_of_another_type(rewritten):
    def change(arrays, metadata):
        arrays[KERNEL] = arrays[KERNEL].astype(np.int32)

    assert f"{KERNEL}: missing or wrong shape" in fault(rewritten(change))


def test_an_array_of_a_type_that_numpy_lacks(tmp_path):
    header = b'{"a":{"dtype":"F8_E5M2","shape":[1],"data_offsets":[0,1]}}'
    content = len(header).to_bytes(8, "little") + header + bytes(1)
    (tmp_path / "a.safetensors").write_bytes(content)
    assert "not readable as weights" in fault(str(tmp_path / "a.safetensors"))


KERNEL = "params/refiner/g/dense_0/kernel"


def test_a_missing_array(rewritten):
    path = rewritten(lambda arrays, metadata: arrays.pop(KERNEL))
    assert f"{KERNEL}: missing or wrong shape" in fault(path)


def test_an_array_of_another_shape(rewritten):
    def change(arrays, metadata):
        arrays[KERNEL] = np.ascontiguousarray(arrays[KERNEL].T)

    assert f"{KERNEL}: missing or wrong shape" in fault(rewritten(change))


def test_an_array_too_many(rewritten):
    def change(arrays, metadata):
        arrays["params/refiner/more"] = np.zeros(3, np.float32)

    assert "unknown array params/refiner/more" in fault(rewritten(change))


def test_another_configuration_for_the_same_arrays(rewritten):
    def change(arrays, metadata):
        config = json.loads(metadata["config"])
        config["model"]["auxiliary"]["hidden"] = 16
        metadata["config"] = json.dumps(config)

    assert ": missing or wrong shape" in fault(rewritten(change))


def test_a_failed_write_leaves_what_was_there(file, tmp_path, tiny, tiny_variables):
    path = tmp_path / "kept.safetensors"
    path.write_bytes(file.read_bytes())
    with pytest.raises(TypeError):
        save_weights(path, tiny, tiny_variables, {"scores": object()})
    assert path.read_bytes() == file.read_bytes()
    with pytest.raises(InputError, match="cannot be written"):
        save_weights(tmp_path / "no" / "such.safetensors", tiny, {}, {})
