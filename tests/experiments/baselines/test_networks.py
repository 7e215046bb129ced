"""What holds of every network to compare with; each one's formulas are beside this."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from experiments.baselines.networks import NETWORKS
from prism_jax.losses.chamfer import primary_loss
from tests.experiments.baselines.conftest import TINY
from tests.trees import drawn

# A softmax, which seed generators do without, does not see its logits' bias, nor a
# difference that of its terms.
UNSEEN = ("attention_1/bias", "seed/bias")


@pytest.fixture(scope="module", params=TINY)
def tiny(request, tiny_network):
    return tiny_network(request.param)


@pytest.mark.parametrize(
    ("name", "size", "stages", "parameters"),
    [
        ("pcn", "paper", (1024, 16384), 6_861_059),
        ("pcn", "small", (128, 2048), 1_127_427),
        pytest.param(
            *("fsc", "paper", (1024, 16384), 29_650_051), marks=pytest.mark.slow
        ),
        ("fsc", "small", (128, 2048), 1_488_307),
        pytest.param(
            *("pointr", "paper", (448, 16384), 31_276_806), marks=pytest.mark.slow
        ),
        ("pointr", "small", (192, 2048), 980_342),
        pytest.param(
            *("seedformer", "paper", (256, 512, 2048, 16384), 3_308_620),
            marks=pytest.mark.slow,
        ),
        ("seedformer", "small", (128, 256, 2048), 634_089),
    ],
)
def test_stages_and_parameters(name, size, stages, parameters):
    """Of the authors' releases, but for what never runs there."""
    network = NETWORKS[name][size]
    partial = jnp.zeros((2, network.config.num_points, 3))
    made, variables = jax.eval_shape(
        lambda: network.init_with_output(jax.random.key(0), partial)
    )
    assert [stage.shape for stage in made] == [(2, n, 3) for n in stages]
    assert network.config.num_outputs == stages[-1]
    found = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    assert found == parameters
    normed = getattr(network.config, "use_norm", False)
    assert ("batch_stats" in variables) == normed


def test_the_order_of_points_is_free_but_for_the_first(tiny):
    _, variables, partial, apply = tiny
    count = partial.shape[1]
    order = np.append(0, 1 + np.random.default_rng(0).permutation(count - 1))
    expected, shuffled = apply(variables, partial), apply(variables, partial[:, order])
    for a, b in zip(expected[:-1], shuffled[:-1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    # PoinTr appends the partial as it comes.
    a, b = (np.sort(stages[-1], axis=1) for stages in (expected, shuffled))
    np.testing.assert_allclose(a, b, atol=1e-5)
    moved = apply(variables, partial + 0.5)
    assert np.abs(moved[0] - expected[0]).max() > 1e-3


def degenerate(points):
    """Of one point, at the origin, collinear and far away."""
    yield np.broadcast_to(points[:1, :1], points.shape)
    yield 0 * points
    yield points[..., :1] * np.float32([1, 2, -1])
    yield points + 1e3


@pytest.mark.slow
def test_gradients_reach_every_parameter_and_stay_finite(tiny, quick_jit):
    """Of Eq. 10 over a batch and the stages; in a mapped network as in a batch."""
    network, variables, partial, apply = tiny
    complete = jnp.concatenate([partial, 0.3 * partial], axis=1)

    def loss(params, partial, complete):
        mapped = jax.vmap(lambda cloud: network.apply({"params": params}, cloud))
        stages = mapped(partial)
        return jax.vmap(primary_loss)(stages, complete).mean(), stages

    loss_and_grad = quick_jit(jax.value_and_grad(loss, has_aux=True))
    (_, stages), grads = loss_and_grad(variables["params"], partial, complete)
    for mapped, stage in zip(stages, apply(variables, partial), strict=True):
        np.testing.assert_allclose(mapped, stage, atol=1e-5)
    for name, leaf in flatten_dict(grads, sep="/").items():
        largest = np.abs(leaf).max()
        unseen = name.endswith(UNSEEN) and not name.startswith("seed_generator")
        assert largest < 1e-5 if unseen else largest > 0, name
    for cloud in degenerate(np.array(partial)):
        found = loss_and_grad(variables["params"], cloud, complete)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fsc", "pointr", "seedformer"])
def test_training_moves_the_statistics_and_nothing_else_does(
    name, tiny_network, quick_jit
):
    config = dataclasses.replace(TINY[name].config, use_norm=True)
    network, partial = type(TINY[name])(config), tiny_network(name).partial
    variables = drawn(network, partial)
    trained = quick_jit(
        lambda v, p: network.apply(v, p, train=True, mutable=["batch_stats"])
    )
    stages, updated = trained(variables, partial)
    assert all(np.isfinite(stage).all() for stage in stages)
    before, after = (flatten_dict(v["batch_stats"]) for v in (variables, updated))
    assert before.keys() == after.keys()
    for path, leaf in after.items():
        assert np.abs(leaf - before[path]).max() > 1e-6, path
    # Statistics are not mutable here, so that touching them would raise.
    plain = quick_jit(network.apply)(variables, partial)
    assert np.abs(stages[-1] - plain[-1]).max() > 1e-3
