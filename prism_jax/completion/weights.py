"""Released weights: ``.safetensors`` files with all that is known of them.

The metadata hold the configuration, the training data, the seed, the commit and the
measured scores as JSON. Nothing is ever unpickled.
"""

import copy
import dataclasses
import functools
import hashlib
import json
import operator
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from flax.traverse_util import unflatten_dict

from prism_jax.adaptation.config import AdaptConfig, PrismConfig
from prism_jax.assets import asset
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.io.files import parsing
from prism_jax.models.config import AuxiliaryConfig, BackboneConfig, ModelConfig
from prism_jax.models.initial import init_variables
from prism_jax.models.variables import Variables
from prism_jax.uncertainty.confidence import Calibration
from prism_jax.uncertainty.sigma import PointErrors
from prism_jax.uncertainty.trees import Trees

SUFFIX = ".safetensors"
RETIRED = {
    "model.backbone.reads_depth": False,
    "adapt.visibility_weight": 0.0,
    "adapt.keep_weight": 0.0,
    "adapt.learned_weight": 0.0,
    "adapt.balance": False,
}
"""Fields that configurations once had, with the value at which they changed nothing:
files that name them load if they have that value."""

RENAMED = {"told": "uses_visibility"}  # fields of the model that had another name

# What an array is called in a file, by its place in the tree.
_key = functools.partial(jax.tree_util.keystr, simple=True, separator="/")


def available_weights() -> list[str]:
    """Names of the weights that ship with the package."""
    return sorted(path.stem for path in asset("").glob(f"*{SUFFIX}"))


def load_pretrained(name_or_path: str = "small") -> tuple[PrismConfig, Variables]:
    """Configuration and variables of released weights, given by name or file.

    An unknown name, or a file without such weights, raises `prism_jax.io.InputError`,
    a ``ValueError`` with a one-line message.
    """
    path = _locate(name_or_path)
    metadata, arrays = read_file(path)
    with parsing(path, "weights of prism_jax", _remedy(), Exception):
        config = config_from_dict(metadata["config"])
        if name_or_path in available_weights():
            return config, _tree(arrays)
        wanted = _shapes(config.model)  # sizes may not fit together
    return config, checked_arrays(arrays, wanted, path)


def read_metadata(name_or_path: str) -> dict[str, Any]:
    """What is known of weights, by name or by file: data, seed, commit, scores."""
    return read_file(_locate(name_or_path))[0]


def load_calibration(name_or_path: str) -> Calibration | None:
    """What gives completions by these weights a verdict; None if they come without.

    One that is damaged, or of another network's features, raises InputError.
    """
    return _load_trees(name_or_path, "calibration", Calibration)


def load_point_errors(name_or_path: str) -> PointErrors | None:
    """What gives points predicted by these weights their sigma; None and InputError as
    for `load_calibration`."""
    return _load_trees(name_or_path, "point_errors", PointErrors)


def _load_trees(name_or_path: str, key: str, kind: type[Trees]) -> Any:
    metadata = read_metadata(name_or_path)
    if metadata.get(key) is None:
        return None
    with parsing(name_or_path, "sound weights", _remedy(), Exception):
        found = kind.from_dict(metadata[key])
        if isinstance(found, Calibration):
            width = metadata["config"]["model"]["backbone"]["global_features"][-1]
            if (own := len(found.feature_mean)) != width:
                raise ValueError(f"a calibration of {own} features, not {width}")
        return found


def file_sha256(name_or_path: str) -> str:
    """Of a file of weights, by name or by file, as `sha256sum` prints it."""
    return hashlib.sha256(_locate(name_or_path).read_bytes()).hexdigest()


def trainings(metadata: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What is known of each training that led to the weights, the first one first."""
    runs = [metadata]
    while runs[0].get("pretrained"):
        runs.insert(0, runs[0]["pretrained"])
    return runs


def samples_seen(metadata: Mapping[str, Any]) -> int:
    """Samples of all `trainings` together."""
    return sum(run.get("samples", 0) for run in trainings(metadata))


def read_file(path: pathlib.Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Metadata and arrays of a file; one that is no such weights raises InputError."""
    with parsing(path, "readable as weights", _remedy(), Exception):
        with safetensors.safe_open(path, framework="numpy") as file:
            text = file.metadata() or {}
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return {key: json.loads(value) for key, value in text.items()}, arrays


def save_weights(
    path: str | pathlib.Path,
    config: PrismConfig,
    variables: Variables,
    metadata: dict[str, Any],
) -> None:
    """Writes weights whole or not at all; metadata values become JSON."""
    write_file(path, variables, {"config": dataclasses.asdict(config), **metadata})


def write_file(
    path: str | pathlib.Path, variables: Variables, metadata: dict[str, Any]
) -> None:
    """Writes arrays and metadata whole or not at all."""
    arrays = {
        _key(leaf_path): np.asarray(leaf)
        for leaf_path, leaf in jax.tree_util.tree_leaves_with_path(variables)
    }
    text = {key: json.dumps(value, sort_keys=True) for key, value in metadata.items()}
    write_bytes(path, _in_order(safetensors.numpy.save(arrays, text)))


def _in_order(file: bytes) -> bytes:
    """The same file with its metadata sorted: safetensors writes them in any order, and
    equal weights would not be equal files."""
    size = int.from_bytes(file[:8], "little")
    header = json.loads(file[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + file[8 + size :]


def sha256(variables: Variables) -> str:
    """Of all arrays, their names, types and shapes: equal for equal bytes alone."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(variables):
        array = np.asarray(leaf)
        digest.update(f"{_key(path)} {array.dtype} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def config_from_dict(fields: dict[str, Any]) -> PrismConfig:
    """The configuration whose ``dataclasses.asdict`` went through JSON.

    A field of `RETIRED` at another value than the neutral one raises ValueError.
    """
    fields = copy.deepcopy(fields)
    for name, neutral in RETIRED.items():
        *path, field = name.split(".")
        value = functools.reduce(operator.getitem, path, fields).pop(field, neutral)
        if value != neutral:
            raise ValueError(f"{name}={value} is no longer supported")
    model, adapt = fields["model"], fields["adapt"]
    model: Any = {RENAMED.get(name, name): value for name, value in model.items()}
    if unknown := fields.keys() - {"model", "adapt"}:
        raise TypeError(f"unknown settings {sorted(unknown)}")
    backbone = BackboneConfig(**_tuples(model.pop("backbone")))
    auxiliary = AuxiliaryConfig(**_tuples(model.pop("auxiliary")))
    return PrismConfig(ModelConfig(backbone, auxiliary, **model), AdaptConfig(**adapt))


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _locate(name_or_path: str) -> pathlib.Path:
    if name_or_path in available_weights():
        return asset(f"{name_or_path}{SUFFIX}")
    path = pathlib.Path(name_or_path)
    if not path.is_file():
        raise InputError(name_or_path, "no such weights", _remedy())
    return path


def _remedy() -> str:
    names = ", ".join(available_weights()) or "none are released"
    return f"give a {SUFFIX} file of prism_jax, or one of: {names}"


def _tree(arrays: dict[str, np.ndarray]) -> Variables:
    """The arrays as a tree. What ships is not compared with its configuration: the
    tests have done so, and it takes seconds."""
    parts = "point_encoder", "decoder", "depth_encoder"
    nothing = {f"batch_stats/{part}": {} for part in parts}
    # All at once: one by one takes most of a second.
    return jax.device_put(unflatten_dict({**nothing, **arrays}, sep="/"))


@functools.cache
def _shapes(config: ModelConfig) -> Variables:
    """Of a network's variables: no memory is taken for what a configuration says."""
    return jax.eval_shape(lambda: init_variables(jax.random.key(0), config))


def checked_arrays(
    arrays: dict[str, np.ndarray], wanted: Variables, path: pathlib.Path
) -> Variables:
    """The arrays in a tree of such shapes; InputError if one is missing, misshapen or
    unknown."""

    def pick(leaf_path: tuple[Any, ...], leaf: jax.ShapeDtypeStruct) -> jax.Array:
        key = _key(leaf_path)
        array = arrays.pop(key, None)
        if array is None or array.shape != leaf.shape or array.dtype.kind != "f":
            raise InputError(path, f"{key}: missing or wrong shape", _remedy())
        return jnp.asarray(array, leaf.dtype)

    variables = jax.tree_util.tree_map_with_path(pick, wanted)
    if arrays:
        raise InputError(path, f"unknown array {min(arrays)}", _remedy())
    return variables
