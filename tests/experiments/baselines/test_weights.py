"""Weights that lie beside the launchers: by name, and those of other networks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.baselines.networks import NETWORKS
from experiments.baselines.weights import load_network, save_network, with_weights
from experiments.table_1 import LABELS
from prism_jax.completion.weights import load_pretrained, read_metadata, sha256
from prism_jax.io.errors import InputError


def test_a_network_to_compare_with_comes_back(tmp_path, name="pcn"):
    module = NETWORKS[name]["small"]
    cloud = jnp.zeros((1, module.config.num_points, 3))
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), cloud))
    rng = np.random.default_rng(0)
    fill = lambda leaf: rng.normal(size=leaf.shape).astype(np.float32)  # noqa: E731
    variables = {"params": jax.tree.map(fill, shapes["params"]), "batch_stats": {}}
    path = tmp_path / "network.safetensors"
    save_network(path, name, "small", variables, {"seed": 3})
    again, loaded = load_network(str(path))
    assert again == module
    assert sha256(loaded) == sha256(variables)
    assert read_metadata(str(path))["seed"] == 3
    with pytest.raises(InputError, match="not weights of prism_jax"):
        load_pretrained(str(path))


def test_what_is_not_a_network_to_compare_with(monkeypatch):
    """Ours, and one without weights here, which is no row of the table."""
    with pytest.raises(InputError, match="not a network to compare with"):
        load_network("prism")
    there = with_weights()
    assert there == sorted(NETWORKS) and set(LABELS) >= set(NETWORKS)
    monkeypatch.setitem(NETWORKS, "another", {})
    assert with_weights() == there
    with pytest.raises(InputError, match="another: no such network") as raised:
        load_network("another")
    assert str(there) in str(raised.value)
