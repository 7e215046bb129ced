"""Weights of the official CRA-PCN (PyTorch) as variables of this port."""

import io
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from flax.traverse_util import unflatten_dict

from prism_jax.io.errors import InputError, require
from prism_jax.io.files import read_bytes
from prism_jax.models.config import BackboneConfig

PUBLISHED = {"pcn": BackboneConfig(), "sn55": BackboneConfig(up_factors=(1, 4, 4))}
"""The published variants, of 16,384 and 8,192 points."""

_WRAPPERS = ("model", "base_model", "state_dict")
_FAULTS_NAMED = 5


def load_torch(path: str | os.PathLike, config: BackboneConfig) -> dict[str, Any]:
    """Variables from an official CRA-PCN checkpoint (``.pth``).

    Needs PyTorch, the optional extra ``torch``. Only tensors and plain values are
    unpickled. A missing extra, and a file that cannot be read, is no such checkpoint
    or does not fit ``config``, raise an InputError.
    """
    torch = require("torch", "torch")
    data = read_bytes(path)
    try:
        loaded = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    # A damaged file may raise almost anything from torch.
    except Exception as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            path,
            f"not a PyTorch checkpoint of tensors only ({reason})",
            "save it again as torch.save(model.state_dict(), path)",
        ) from error
    try:
        arrays = {
            name: value.detach().float().numpy()
            for name, value in _unwrapped(loaded).items()
            if isinstance(value, torch.Tensor)
        }
        return convert_state_dict(arrays, config)
    except (TypeError, ValueError) as error:
        raise InputError(
            path,
            str(error),
            "use an official CRA-PCN checkpoint and the config of the same variant",
        ) from error


def convert_state_dict(
    state_dict: Mapping[str, Any], config: BackboneConfig
) -> dict[str, Any]:
    """Variables ``{"params": {point_encoder, decoder}, "batch_stats": ...}``.

    Takes the arrays of an official state dict by their PyTorch names, also inside a
    checkpoint's ``model`` or ``base_model``, with or without the ``module.`` prefix of
    data-parallel training. The set abstractions' BatchNorm, which the network never
    applies, and the batch counters are dropped. Every other key must be there, in its
    shape, and no more: a ValueError names the first faults. Pure NumPy, float32.

    Source: Rong et al., CRA-PCN, AAAI 2024, and the layer names of its public code.
    """
    if not config.use_norm:
        raise ValueError("official weights have BatchNorm: use_norm must be True")
    if config.seeds_from_patches:
        raise ValueError(
            "official seeds are absolute: seeds_from_patches must be False"
        )
    weights = _Weights(_unwrapped(state_dict))
    _encoder(weights, config)
    _seed_generator(weights, config)
    for i, times in enumerate(config.up_factors):
        levels = len(config.level_rates[i])
        _block(weights, config, f"decoder.ub{i}", f"decoder/block_{i}", times, levels)
    weights.finish()
    return {
        "params": unflatten_dict(weights.params, sep="/"),
        "batch_stats": unflatten_dict(weights.batch_stats, sep="/"),
    }


def _unwrapped(checkpoint: Any) -> dict[str, Any]:
    """The state dict inside a checkpoint, without data-parallel prefixes."""
    if not isinstance(checkpoint, Mapping):
        raise TypeError(f"holds a {type(checkpoint).__name__}, not a state dict")
    for wrapper in _WRAPPERS:
        if isinstance(checkpoint.get(wrapper), Mapping):
            return _unwrapped(checkpoint[wrapper])
    return {str(name).removeprefix("module."): v for name, v in checkpoint.items()}


class _Weights:
    """Moves arrays, each asked for by name and shape, and collects every fault.

    Sources are PyTorch names, targets Flax paths with slashes.
    """

    def __init__(self, state_dict: Mapping[str, Any]):
        self.params: dict[str, np.ndarray] = {}
        self.batch_stats: dict[str, np.ndarray] = {}
        self._faults: list[str] = []
        self._left = {
            name: np.asarray(array)
            for name, array in state_dict.items()
            if not name.endswith(".num_batches_tracked")
        }

    def dense(
        self, source: str, target: str, inputs: int, outputs: int, axes: int = 1
    ) -> None:
        """A 1x1 convolution over ``axes`` axes."""
        weight = self._take(f"{source}.weight", (outputs, inputs) + (1,) * axes)
        self._put(f"{target}/kernel", weight.reshape(outputs, inputs).T)
        self._put(f"{target}/bias", self._take(f"{source}.bias", (outputs,)))

    def split(
        self, source: str, target: str, shape: tuple[int, ...], bias: bool
    ) -> None:
        """A transposed convolution of (inputs, outputs, times) whose stride is its
        kernel."""
        kernel = self._take(f"{source}.weight", shape).reshape(shape[:3])
        self._put(f"{target}/dense/kernel", kernel.transpose(0, 2, 1))
        if bias:
            self._put(f"{target}/bias", self._take(f"{source}.bias", shape[1:2]))

    def norm(self, source: str, target: str, width: int) -> None:
        self._put(f"{target}/scale", self._take(f"{source}.weight", (width,)))
        self._put(f"{target}/bias", self._take(f"{source}.bias", (width,)))
        for name in ("mean", "var"):
            array = self._take(f"{source}.running_{name}", (width,))
            self.batch_stats[f"{target}/{name}"] = np.asarray(array, np.float32)

    def residual(
        self, source: str, target: str, inputs: int, hidden: int, outputs: int
    ) -> None:
        self.dense(f"{source}.conv_1", f"{target}/dense_0", inputs, hidden)
        self.dense(f"{source}.conv_2", f"{target}/dense_1", hidden, outputs)
        self.dense(f"{source}.conv_shortcut", f"{target}/shortcut", inputs, outputs)

    def drop_norm(self, source: str, width: int) -> None:
        for name in ("weight", "bias", "running_mean", "running_var"):
            self._take(f"{source}.{name}", (width,))

    def finish(self) -> None:
        """Raises if anything was missing, misshapen or left over."""
        faults = self._faults + [f"{name} is unexpected" for name in self._left]
        if faults:
            more = len(faults) - _FAULTS_NAMED
            named = ", ".join(faults[:_FAULTS_NAMED])
            raise ValueError(named + (f", and {more} more" if more > 0 else ""))

    def _take(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        array = self._left.pop(name, None)
        if array is not None and array.shape == shape:
            return array
        found = "is missing" if array is None else f"has shape {array.shape}"
        self._faults.append(f"{name} {found} (expected {shape})")
        return np.zeros(shape)

    def _put(self, target: str, array: np.ndarray) -> None:
        self.params[target] = np.ascontiguousarray(array, np.float32)


def _encoder(weights: _Weights, config: BackboneConfig) -> None:
    width, (first, second) = config.features, config.patch_features
    levels = len(config.encoder_rates)
    modules = (
        ("encoder.sa_module_1", "abstraction_1/mlp", (6, *first)),
        ("encoder.sa_module_2", "abstraction_2/mlp", (3 + width, *second)),
        ("encoder.sa_module_3", "global", (3 + second[1], *config.global_features)),
    )
    for source, target, widths in modules:
        for i in range(2):
            layer = f"{source}.mlp_conv.{i}"
            path = f"point_encoder/{target}/dense_{i}"
            weights.dense(f"{layer}.conv", path, widths[i], widths[i + 1], axes=2)
            weights.drop_norm(f"{layer}.bn", widths[i + 1])
    for i in (1, 2):
        target = f"point_encoder/transformer_{i}"
        _transformer(weights, config, f"encoder.crt_{i}", target, levels)
    weights.dense("encoder.conv_21", "point_encoder/reduce", second[1], width)
    weights.dense("encoder.conv_22", "point_encoder/expand", width, second[1])


def _seed_generator(weights: _Weights, config: BackboneConfig) -> None:
    source, target = "seed_generator", "decoder/seed_generator"
    width, inner = config.features, config.attention_features
    patch = config.patch_features[1][1]
    joined = width + config.global_features[1]
    upsample, hidden = f"{target}/upsample", config.attention_ratio * inner
    _attention(weights, config, f"{source}.uptrans", upsample, patch)
    shape = (hidden, inner, config.seed_times, 1)
    last = f"{source}.uptrans.attn_mlp.3"
    weights.split(last, f"{upsample}/attention_1", shape, bias=True)
    residual = f"{source}.uptrans.residual_layer"
    weights.dense(residual, f"{upsample}/residual", patch, width)
    weights.residual(f"{source}.mlp_1", f"{target}/mlp_1", joined, width, width)
    weights.residual(f"{source}.mlp_2", f"{target}/mlp_2", width, width // 2, width)
    weights.residual(f"{source}.mlp_3", f"{target}/mlp_3", joined, width, width)
    coordinates = f"{target}/coordinates"
    weights.dense(f"{source}.mlp_4.0", f"{coordinates}/dense_0", width, width // 2)
    weights.dense(f"{source}.mlp_4.2", f"{coordinates}/dense_1", width // 2, 3)


def _block(
    weights: _Weights,
    config: BackboneConfig,
    source: str,
    target: str,
    times: int,
    levels: int,
) -> None:
    width = config.features
    joined = 2 * width + config.global_features[1]
    dense, point = weights.dense, f"{source}.pn.mlp"
    dense(f"{point}_1.mlp.0", f"{target}/point_0/dense_0", 3, width // 2)
    dense(f"{point}_1.mlp.2", f"{target}/point_0/dense_1", width // 2, width)
    dense(f"{point}_2.mlp.0", f"{target}/point_1/dense_0", joined, 4 * width)
    dense(f"{point}_2.mlp.2", f"{target}/point_1/dense_1", 4 * width, 2 * width)
    dense(f"{point}_2.mlp.4", f"{target}/point_1/dense_2", 2 * width, width)
    for name in ("inter", "intra"):
        crt = f"{source}.{name}_crt"
        _transformer(weights, config, crt, f"{target}/{name}", levels)
    head = f"{source}.deconv"
    reduce, offset = f"{head}.decrease_dim.mlp", f"{head}.xyz_mlp.mlp"
    dense(f"{reduce}.0", f"{target}/reduce_0", width, width // 2)
    weights.norm(f"{reduce}.1", f"{target}/norm", width // 2)
    dense(f"{reduce}.3", f"{target}/reduce_1", width // 2, width // 4)
    shape = (width // 4, width, times)
    weights.split(f"{head}.ps", f"{target}/split", shape, bias=False)
    weights.residual(f"{head}.mlp_res", f"{target}/child", 2 * width, width, width)
    dense(f"{offset}.0", f"{target}/offset/dense_0", width, width // 2)
    dense(f"{offset}.2", f"{target}/offset/dense_1", width // 2, 3)


def _transformer(
    weights: _Weights, config: BackboneConfig, source: str, target: str, levels: int
) -> None:
    width, inner = config.features, config.attention_features
    hidden = config.attention_ratio * inner
    for i in range(levels):
        attention, path = f"{source}.attn_lists.{i}", f"{target}/attention_{i}"
        _attention(weights, config, attention, path, width)
        last = f"{attention}.attn_mlp.3"
        weights.dense(last, f"{path}/attention_1", hidden, inner, axes=2)
    for i in range(levels - 1):
        for letter, cloud in (("q", "query"), ("s", "support")):
            mlp, path = f"{source}.{letter}_mlp_lists.{i}", f"{target}/{cloud}_{i}"
            weights.residual(mlp, path, 2 * width, width, width)


def _attention(
    weights: _Weights, config: BackboneConfig, source: str, target: str, inputs: int
) -> None:
    """A vector attention but for its last attention layer, which has two kinds."""
    inner = config.attention_features
    hidden = config.attention_ratio * inner
    for name in ("query", "key", "value"):
        weights.dense(f"{source}.conv_{name}", f"{target}/{name}", inputs, inner)
    position = f"{target}/position"
    weights.dense(f"{source}.pos_mlp.0", f"{position}_0", 3, inner, axes=2)
    weights.norm(f"{source}.pos_mlp.1", f"{position}_norm", inner)
    weights.dense(f"{source}.pos_mlp.3", f"{position}_1", inner, inner, axes=2)
    hidden_layer = f"{source}.attn_mlp.0"
    weights.dense(hidden_layer, f"{target}/attention_0", inner, hidden, axes=2)
    weights.norm(f"{source}.attn_mlp.1", f"{target}/norm", hidden)
    weights.dense(f"{source}.conv_end", f"{target}/end", inner, config.features)
