"""Official weights as variables."""

import dataclasses
from collections import OrderedDict

import chex
import jax
import numpy as np
import pytest

from experiments.baselines.crapcn import convert_state_dict, load_torch
from prism_jax.io.errors import InputError
from prism_jax.models.backbone import init_backbone
from prism_jax.models.config import BackboneConfig
from tests.io.test_arrays import Bomb
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
    assert f"{name} is missing" in message({name: None})
    assert "decoder.more is unexpected" in message({"decoder.more": np.zeros(1)})
    misshapen = message({name: state_dict[name][..., :2]})
    shape = state_dict[name].shape
    assert f"{name} has shape {(*shape[:2], 2)} (expected {shape})" in misshapen
    assert len(message(dict.fromkeys(state_dict))) < 500
    assert "use_norm" in message({}, BackboneConfig(use_norm=False))
    assert "seeds" in message({}, BackboneConfig(seeds_from_patches=True))


def test_load_torch(official, tmp_path):
    torch = pytest.importorskip("torch")
    config, state_dict, expected = official
    path = tmp_path / "weights.pth"
    tensors = {f"module.{n}": torch.from_numpy(a) for n, a in state_dict.items()}
    for is_zip in (False, True):
        torch.save({"model": tensors}, path, _use_new_zipfile_serialization=is_zip)
        assert bitwise(load_torch(path, config), expected)

    def refused(fault, config=config):
        with pytest.raises(InputError, match=f"^{path}.*{fault}"):
            load_torch(path, config)

    other_variant = dataclasses.replace(config, up_factors=(1, 2, 8))
    refused("decoder.ub1.deconv.ps.weight has shape", other_variant)
    path.write_bytes(path.read_bytes()[:1000])
    refused("not a PyTorch checkpoint")
    torch.save([1, 2], path)
    refused("not a state dict")
    torch.save({"model": Bomb()}, path)
    refused("tensors only")
