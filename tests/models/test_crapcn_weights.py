"""Official weights as variables."""

import dataclasses
import sys
from collections import OrderedDict

import chex
import jax
import numpy as np
import pytest

from experiments.baselines.crapcn import convert_state_dict, load_torch
from prism_jax.io.errors import InputError
from prism_jax.models.backbone import init_backbone
from prism_jax.models.config import BackboneConfig
from tests.trees import bitwise


@pytest.fixture(scope="module")
def official(published):
    """The network's config, state dict and variables."""
    network = published("pcn")
    return network.config, network.state_dict, network.variables


def test_gives_the_variables_of_the_modules(official):
    config, _, converted = official
    expected = jax.eval_shape(lambda: init_backbone(jax.random.key(0), config))
    chex.assert_trees_all_equal_shapes_and_dtypes(converted, expected)


def test_wrapped_checkpoints(official):
    config, state_dict, expected = official
    parallel = {f"module.{name}": array for name, array in state_dict.items()}
    counters = {"encoder.sa_module_1.mlp_conv.0.bn.num_batches_tracked": np.array(3)}
    for checkpoint in (
        {"epoch_index": 3, "best_metrics": 6.39, "model": parallel},
        {"base_model": OrderedDict(state_dict | counters), "optimizer": {}},
    ):
        assert bitwise(convert_state_dict(checkpoint, config), expected)


def test_faults_are_named(official):
    config, state_dict, _ = official

    def message(changes, config=config):
        state = {n: a for n, a in (state_dict | changes).items() if a is not None}
        with pytest.raises(ValueError) as caught:
            convert_state_dict(state, config)
        return str(caught.value)

    name = "decoder.ub1.deconv.ps.weight"
    unused = "encoder.sa_module_3.mlp_conv.1.bn.running_var"
    for missing in (name, unused):
        assert f"{missing} is missing" in message({missing: None})
    assert "decoder.more is unexpected" in message({"decoder.more": np.zeros(1)})
    misshapen = message({name: state_dict[name][..., :2]})
    shape = state_dict[name].shape
    assert f"{name} has shape {(*shape[:2], 2)} (expected {shape})" in misshapen
    reduce = "encoder.conv_21.weight"
    assert reduce in message({reduce: state_dict[reduce].swapaxes(0, 1)})
    everything = message(dict.fromkeys(state_dict))
    assert "more" in everything and len(everything) < 500
    assert "use_norm" in message({}, BackboneConfig(use_norm=False))
    assert "seeds" in message({}, BackboneConfig(seeds_from_patches=True))


def test_load_torch(official, tmp_path):
    torch = pytest.importorskip("torch")
    config, state_dict, expected = official
    path, written = tmp_path / "weights.pth", tmp_path / "written"
    tensors = {f"module.{n}": torch.from_numpy(a) for n, a in state_dict.items()}
    for is_zip in (False, True):
        torch.save({"model": tensors}, path, _use_new_zipfile_serialization=is_zip)
        assert bitwise(load_torch(path, config), expected)

    def message(config=config):
        with pytest.raises(InputError) as caught:
            load_torch(path, config)
        line = str(caught.value)
        assert line.startswith(str(path)) and "\n" not in line and len(line) < 700
        return line

    other_variant = dataclasses.replace(config, up_factors=(1, 2, 8))
    assert "decoder.ub1.deconv.ps.weight has shape" in message(other_variant)
    path.write_bytes(path.read_bytes()[:1000])
    assert "not a PyTorch checkpoint" in message()
    torch.save([1, 2], path)
    assert "not a state dict" in message()

    class Command:
        def __reduce__(self):
            return open, (str(written), "w")

    torch.save({"model": Command()}, path)
    assert "tensors only" in message()
    assert not written.exists()


def test_absent_torch_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match=r"prism_jax\[torch\]"):
        load_torch(tmp_path / "weights.pth", BackboneConfig())
