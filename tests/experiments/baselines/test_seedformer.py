"""SeedFormer: its transformers against loops in NumPy, the whole by what is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax

from experiments.baselines.seedformer import UpsampleTransformer
from tests.experiments.baselines.conftest import TINY
from tests.trees import drawn

RNG = np.random.default_rng(0)
NORMED = dataclasses.replace(TINY["seedformer"].config, use_norm=True)
INPUTS = 6


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


def dense(params, x):
    return x @ params["kernel"] + params["bias"]


def norm_relu(params, x):
    x = (x - params["mean"]) / np.sqrt(params["var"] + 1e-5)
    return np.maximum(x * params["scale"] + params["bias"], 0)


def residual_mlp(params, x):
    hidden = np.maximum(dense(params["dense_0"], x), 0)
    return dense(params["dense_1"], hidden) + dense(params["shortcut"], x)


def as_numpy(variables):
    """Parameters as float64, with the statistics beside them."""
    params = jax.tree.map(np.float64, dict(variables["params"]))
    for name, stats in jax.tree.map(np.float64, variables["batch_stats"]).items():
        params[name] |= stats
    return params


def looped_upsampling(params, times, xyz, query, key, neighbors, seed):
    """One point, one child and one neighbour at a time."""
    xyz, query, key = map(np.float64, (xyz, query, key))
    joined = residual_mlp(params["join"], np.concatenate([key, query], -1))
    keys, values = dense(params["key"], key), dense(params["value"], joined)
    seeds = np.zeros_like(keys) if seed is None else dense(params["seed"], seed)
    queries = dense(params["query"], query)
    rows = []
    for i, near in enumerate(np.asarray(neighbors)):
        hidden, terms = [], []
        for j in near:
            offset = dense(params["position_0"], xyz[i] - xyz[j])
            offset = norm_relu(params["position_norm"], offset)
            added = dense(params["position_1"], offset) + seeds[i] - seeds[j]
            pair = dense(params["attention_0"], queries[i] - keys[j] + added)
            hidden.append(norm_relu(params["norm"], pair))
            terms.append(values[j] + added)
        last = params["attention_1"]
        residual = joined[i]
        if "residual" in params:
            residual = dense(params["residual"], residual)
        for child in range(times):
            logits = np.stack(hidden) @ last["dense"]["kernel"][:, child]
            logits = logits + last["bias"]
            weights = logits if seed is None else softmax(logits, axis=0)
            attended = (weights * np.stack(terms)).sum(0)
            rows.append(dense(params["end"], attended) + residual)
    return np.stack(rows)


def upsampling_inputs(with_seeds, channels=NORMED.features, num_points=7):
    neighbors = jnp.asarray(RNG.integers(0, num_points, (num_points, 3)))
    xyz, query, key = (normal(num_points, c) for c in (3, channels, channels))
    return xyz, query, key, neighbors, normal(num_points, 5) if with_seeds else None


@pytest.mark.parametrize(
    ("times", "with_seeds", "channels"),
    [(3, True, NORMED.features), (2, False, INPUTS)],
    ids=["layer", "seed generator"],
)
def test_upsample_transformer_agrees_with_a_loop(
    quick_jit, times, with_seeds, channels
):
    module = UpsampleTransformer(NORMED, times)
    inputs = upsampling_inputs(with_seeds, channels)
    variables = drawn(module, *inputs)
    assert ("residual" in variables["params"]) == (channels != NORMED.features)
    actual = quick_jit(module.apply)(variables, *inputs)
    expected = looped_upsampling(as_numpy(variables), times, *inputs)
    assert actual.shape == (7 * times, NORMED.features)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


def test_without_offsets_every_stage_is_made_of_seeds_and_partial(tiny_network):
    _, variables, partial, apply = tiny_network("seedformer")
    still = jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaf * ("offset" not in jax.tree_util.keystr(path)),
        variables,
    )
    seeds, first, last = (np.asarray(stage[0]) for stage in apply(still, partial))
    np.testing.assert_array_equal(last, np.repeat(first, 2, axis=0))
    known = np.concatenate([seeds, partial[0]])
    distances = np.linalg.norm(known[:, None] - first, axis=-1)
    assert (distances.min(0) == 0).all()
    # Farthest points: sampled ones are farther apart than any other is from them.
    apart = np.linalg.norm(first[:, None] - first, axis=-1)[np.triu_indices(20, 1)]
    assert distances.min(1).max() <= apart.min()
