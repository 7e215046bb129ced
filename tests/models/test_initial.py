"""Fresh variables."""

import jax
import numpy as np
import pytest

from prism_jax.models.initial import init_auxiliary, init_variables
from prism_jax.models.variables import pop_encoders
from prism_jax.training.presets import PRESETS
from tests.trees import bitwise


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


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_has_the_structure(name, variables):
    """Also of a network that takes part in no other test for its size."""
    model = PRESETS[name].model
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), model))
    assert set(shapes["params"]) == set(variables["params"])
    encoders, rest = pop_encoders(shapes)
    assert all(encoders.values())
    assert all(rest["params"].values())


def test_a_key_gives_the_same_variables_and_another_others(minimal, variables):
    first, same, other = (
        init_auxiliary(jax.random.key(seed), variables, minimal.model)
        for seed in (1, 1, 2)
    )
    assert bitwise(first, same)
    kernel = first["params"]["auxiliary"]["normal"]["mlp"]["dense_0"]["kernel"]
    another = other["params"]["auxiliary"]["normal"]["mlp"]["dense_0"]["kernel"]
    assert not np.array_equal(kernel, another)


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
