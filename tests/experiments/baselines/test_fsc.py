"""FSC against its formulas, and what its authors' release says of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from experiments.baselines.fsc import FSC, FSCConfig, OffsetAttention

TINY = FSCConfig(
    num_points=24,
    local_features=(4, 8, 8),
    global_features=(8, 16, 16),
    coarse_features=(16, 16),
    num_coarse=8,
    near_features=(8, 8),
    num_neighbors=3,
    radius=1.8,
    fold_features=(16, 16),
    grid_size=2,
    use_norm=False,
)
RNG = np.random.default_rng(0)
PARTIAL = jnp.asarray(RNG.uniform(-1, 1, (3, 24, 3)), jnp.float32)


@pytest.fixture(scope="module")
def variables():
    """With biases that are not zero."""
    fresh = jax.jit(FSC(TINY).init)(jax.random.key(0), PARTIAL)
    return jax.tree.map(lambda leaf: leaf + 0.1 * (leaf.ndim == 1), fresh)


@pytest.fixture(scope="module")
def complete_fn(quick_jit):
    return quick_jit(FSC(TINY).apply)


def dense(params, x):
    return x @ params["kernel"].reshape(x.shape[-1], -1) + params.get("bias", 0.0)


def layers(params, x, leak=0.2):
    for i in range(len(params)):
        x = dense(params[f"dense_{i}"], x)
        x = np.where(x > 0, x, leak * x)
    return x


def attend(params, x):
    """Of PCT: the weights of all pairs, whose rows and then columns sum to one."""
    keys = dense(params["query_key"]["dense"], x)
    energy = keys @ keys.T
    weights = np.exp(energy - energy.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    weights /= 1e-9 + weights.sum(axis=0, keepdims=True)
    attended = np.stack(
        [weights[:, j] @ dense(params["value"], x) for j in range(len(x))]
    )
    return x + layers(params["offset"], x - attended, 0.0)


def by_hand(variables, partial):
    """One cloud, with every concatenation made and every neighbour looked for."""
    params = jax.tree.map(np.float64, variables["params"])
    own = params["extensive"]
    x = layers(own["local"], np.float64(partial))
    low = x.max(axis=0)
    x = layers(own["global"], np.concatenate([x, np.tile(low, (len(x), 1))], axis=1))
    extensive = np.concatenate([low, x.max(axis=0)])

    own = params["saliency"]
    x = attend(own["attention_0"], layers(own["layer_0"], np.float64(partial)))
    one = attend(own["attention_1"], layers(own["layer_1"], x))
    two = attend(own["attention_2"], one)
    x = layers(own["layer_2"], np.concatenate([one, two], axis=1))
    low = x.max(axis=0)
    x = layers(own["layer_3"], np.concatenate([x, np.tile(low, (len(x), 1))], axis=1))
    one = attend(own["attention_3"], x)
    two = attend(own["attention_4"], one)
    x = layers(own["layer_4"], np.concatenate([one, two], axis=1))
    saliency = np.concatenate([low, x.max(axis=0)])

    both = np.concatenate([extensive, saliency])
    feature = layers(params["revision"], both, 0.0)
    coarse = dense(params["coarse_end"], layers(params["coarse"], feature))
    coarse = coarse.reshape(TINY.num_coarse, 3)
    children = []
    for center, apart in zip(coarse, cdist(coarse, coarse), strict=True):
        near = np.argsort(apart)[: TINY.num_neighbors]
        near = coarse[near[apart[near] <= TINY.radius]]
        grouped = np.concatenate([near - center, near], axis=1)
        around = layers(params["near"]["layers"], grouped, 0.0).max(axis=0)
        for v in (-0.05, 0.05):
            for u in (-0.05, 0.05):
                told = np.concatenate([[u, v], around, feature])
                offset = dense(params["fold_end"], layers(params["fold"], told))
                children.append(center + offset)
    return coarse, np.array(children)


def test_the_formulas(complete_fn, variables):
    coarse, fine = complete_fn(variables, PARTIAL)
    for i in range(3):
        expected = by_hand(variables, PARTIAL[i])
        np.testing.assert_allclose(coarse[i], expected[0], atol=5e-6)
        np.testing.assert_allclose(fine[i], expected[1], atol=5e-6)


def test_some_neighbours_are_beyond_the_radius(complete_fn, variables):
    """Else that formula would say nothing of it."""
    coarse, _ = complete_fn(variables, PARTIAL)
    apart = np.sort(cdist(coarse[0], coarse[0]), axis=1)[:, 1 : TINY.num_neighbors]
    assert 0 < (apart > TINY.radius).mean() < 1


def test_released_number_of_parameters():
    """Of the release's layers, each with a bias and BatchNorm's two vectors, of queries
    and keys one matrix without either."""
    layer = lambda i, o: i * o + 3 * o  # noqa: E731
    attention = lambda c: c * c // 4 + (c * c + c) + layer(c, c)  # noqa: E731
    extensive = sum(
        layer(*sizes)
        for sizes in [(3, 64), (64, 128), (128, 256), (512, 512), (512, 1024)]
    ) + layer(1024, 1024)
    saliency = sum(
        layer(*sizes)
        for sizes in [(3, 64), (64, 64), (64, 128), (256, 256), (512, 512)]
    ) + 2 * layer(1024, 1024)
    saliency += attention(64) + 2 * attention(128) + 2 * attention(512)
    coarse = [(2560, 2048), (2048, 1024), (1024, 2048), (2048, 3 * 1024)]
    decoder = sum(i * o + o for i, o in coarse)
    decoder += layer(6, 64) + layer(64, 128) + layer(128, 256)
    decoder += layer(2560 + 256 + 2, 512) + layer(512, 512) + 512 * 3 + 3
    total = extensive + saliency + layer(2560, 2560) + decoder
    # `test_networks.py` counts those of the network.
    assert total == 29_650_051


def test_what_all_attend_to_alike_has_no_offset(quick_jit):
    """Of equal points the weights are equal, and each one's offset is zero but for what
    the value's layer makes of it."""
    attention = OffsetAttention(use_norm=False)
    x = jnp.ones((5, 8))
    variables = attention.init(jax.random.key(1), x, False)
    params = variables["params"]
    params["value"]["kernel"] = jnp.eye(8)
    found = quick_jit(attention.apply, static_argnums=2)({"params": params}, x, False)
    np.testing.assert_allclose(found, x, atol=1e-6)
