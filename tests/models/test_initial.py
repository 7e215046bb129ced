"""Fresh variables."""

import jax
import numpy as np
import pytest

from prism_jax.models.initial import init_auxiliary, init_variables
from prism_jax.models.variables import pop_encoders
from prism_jax.training.presets import PRESETS


@pytest.fixture(scope="module")
def variables(minimal):
    return init_variables(jax.random.key(0), minimal.model)


def test_structure(variables):
    assert set(variables) == {"params", "batch_stats", "weighting"}
    assert set(variables["params"]) == {
        "point_encoder",
        "depth_encoder",
        "decoder",
        "refiner",
        "auxiliary",
    }
    branches = {"integrator", "projection", "normal", "denoiser"}
    assert set(variables["params"]["auxiliary"]) == branches
    statistics = {"point_encoder", "depth_encoder", "decoder"}
    assert set(variables["batch_stats"]) == statistics
    for leaf in jax.tree.leaves(variables):
        assert leaf.dtype == np.float32
        assert np.isfinite(leaf).all()


def test_losses_start_equally_weighted_and_unmeasured(variables):
    assert np.array_equal(variables["weighting"]["logits"], np.zeros(3))
    assert np.array_equal(variables["weighting"]["scales"], np.zeros(3))


OTHERS = [pytest.param(n, marks=pytest.mark.slow) for n in PRESETS if n != "tiny"]


@pytest.mark.parametrize("name", ["tiny", *OTHERS])
def test_every_preset_has_the_structure(name, variables):
    """Also of a network that takes part in no other test for its size."""
    model = PRESETS[name].model
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), model))
    assert set(shapes["params"]) == set(variables["params"])
    encoders, rest = pop_encoders(shapes)
    assert all(encoders.values())
    assert all(rest["params"].values())


def test_a_key_gives_the_same_variables_and_another_others(minimal, variables):
    same = init_variables(jax.random.key(0), minimal.model)
    assert jax.tree.structure(same) == jax.tree.structure(variables)
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(variables), strict=True):
        assert np.array_equal(a, b)
    other = init_auxiliary(jax.random.key(1), variables, minimal.model)
    kernel = ("params", "auxiliary", "normal", "mlp", "dense_0", "kernel")
    assert not np.array_equal(leaf(other, kernel), leaf(variables, kernel))


def test_a_trained_backbone_is_kept(minimal, variables):
    backbone = {
        kind: {
            name: jax.tree.map(lambda x: x + 1, variables[kind][name])
            for name in ("point_encoder", "decoder")
        }
        for kind in ("params", "batch_stats")
    }
    together = init_auxiliary(jax.random.key(1), backbone, minimal.model)
    for kind, parts in backbone.items():
        for name, tree in parts.items():
            assert together[kind][name] is tree


def leaf(tree, path):
    for name in path:
        tree = tree[name]
    return np.asarray(tree)
