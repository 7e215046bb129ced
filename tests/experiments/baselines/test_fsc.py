"""FSC against its formulas."""

import jax
import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import softmax

from tests.experiments.baselines.conftest import TINY

CONFIG = TINY["fsc"].config


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
    weights = softmax(keys @ keys.T, axis=1)
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
    coarse = coarse.reshape(CONFIG.num_coarse, 3)
    children = []
    for center, apart in zip(coarse, cdist(coarse, coarse), strict=True):
        near = np.argsort(apart)[: CONFIG.num_neighbors]
        near = coarse[near[apart[near] <= CONFIG.radius]]
        grouped = np.concatenate([near - center, near], axis=1)
        around = layers(params["near"]["layers"], grouped, 0.0).max(axis=0)
        for v in (-0.05, 0.05):
            for u in (-0.05, 0.05):
                told = np.concatenate([[u, v], around, feature])
                offset = dense(params["fold_end"], layers(params["fold"], told))
                children.append(center + offset)
    return coarse, np.array(children)


def test_the_formulas(tiny_network):
    fsc = tiny_network("fsc")
    coarse, fine = fsc.apply(fsc.variables, fsc.partial)
    for i in range(3):
        expected = by_hand(fsc.variables, fsc.partial[i])
        np.testing.assert_allclose(coarse[i], expected[0], atol=5e-6)
        np.testing.assert_allclose(fine[i], expected[1], atol=5e-6)
    # Some neighbours are beyond the radius, and some are not.
    apart = np.sort(cdist(coarse[0], coarse[0]), axis=1)[:, 1 : CONFIG.num_neighbors]
    assert 0 < (apart > CONFIG.radius).mean() < 1
