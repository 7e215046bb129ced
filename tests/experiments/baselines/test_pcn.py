"""PCN against its formulas."""

import jax
import numpy as np

from experiments.baselines.pcn import folding_grid


def by_hand(variables, partial):
    """The paper's two equations for one cloud, with every concatenation made."""
    params = jax.tree.map(np.float64, variables["params"])

    def mlp(name, x):
        layers = [params[name][f"dense_{i}"] for i in range(len(params[name]))]
        for layer in layers[:-1]:
            x = np.maximum(x @ layer["kernel"] + layer["bias"], 0)
        return x @ layers[-1]["kernel"] + layers[-1]["bias"]

    f = mlp("local", np.float64(partial))
    f = mlp("global", np.concatenate([f, np.tile(f.max(0), (len(f), 1))], 1))
    feature = f.max(0)
    coarse = mlp("coarse", feature).reshape(8, 3)
    dense = [
        center + mlp("fold", np.concatenate([[u, v], center, feature]))
        for center in coarse
        for v in (-0.05, 0.05)
        for u in (-0.05, 0.05)
    ]
    return coarse, np.array(dense)


def test_the_papers_formulas(tiny_network):
    pcn = tiny_network("pcn")
    coarse, dense = pcn.apply(pcn.variables, pcn.partial)
    for i in range(3):
        expected = by_hand(pcn.variables, pcn.partial[i])
        np.testing.assert_allclose(coarse[i], expected[0], atol=2e-6)
        np.testing.assert_allclose(dense[i], expected[1], atol=2e-6)


def test_published_grid():
    """Four by four points, 0.1 wide, evenly spaced around the origin."""
    side = [-0.05, -0.05 / 3, 0.05 / 3, 0.05]
    expected = [(u, v) for v in side for u in side]
    np.testing.assert_allclose(folding_grid(4, 0.05), expected, atol=1e-7)
