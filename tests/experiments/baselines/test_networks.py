"""What holds of every network to compare with; each one's formulas are beside this."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from experiments.baselines.fsc import FSC
from experiments.baselines.networks import NETWORKS
from experiments.baselines.pcn import PCN
from experiments.baselines.pointr import PoinTr
from experiments.baselines.seedformer import SeedFormer
from prism_jax.losses.primary import primary_loss
from tests.experiments.baselines import (
    test_fsc,
    test_pcn,
    test_pointr,
    test_seedformer,
)

TINY = {
    "pcn": PCN(test_pcn.TINY),
    "fsc": FSC(test_fsc.TINY),
    "pointr": PoinTr(test_pointr.TINY),
    "seedformer": SeedFormer(test_seedformer.TINY),
}
RNG = np.random.default_rng(0)
# A softmax, which seed generators do without, does not see its logits' bias, nor a
# difference that of its terms.
UNSEEN = ("attention_1/bias", "seed/bias")


def drawn(network, *inputs):
    """Variables of any numbers: none of the compilation that fresh ones cost."""
    tree = jax.eval_shape(lambda: network.init(jax.random.key(0), *inputs))

    def draw(path, leaf):
        values = RNG.normal(size=leaf.shape) / leaf.shape[0] ** 0.5
        values = abs(values) + 0.1 if path[-1].key == "var" else values
        return jnp.asarray(values, jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, tree)


@pytest.fixture(scope="module", params=TINY)
def network(request):
    return TINY[request.param]


@pytest.fixture(scope="module")
def clouds(network):
    """Three partials and their wholes."""
    count = network.config.num_points
    complete = jnp.asarray(0.4 * RNG.normal(size=(3, count + 32, 3)), jnp.float32)
    return complete[:, :count], complete


@pytest.fixture(scope="module")
def variables(network, clouds):
    return drawn(network, clouds[0])


@pytest.fixture(scope="module")
def loss_and_grad(network, quick_jit):
    """Eq. 10 over a batch and the stages, and the gradient in the parameters."""

    def loss(params, partial, complete):
        stages = network.apply({"params": params}, partial)
        return jax.vmap(primary_loss)(stages, complete).mean(), stages

    return quick_jit(jax.value_and_grad(loss, has_aux=True))


@pytest.fixture(scope="module")
def complete_fn(network, variables, quick_jit):
    """The stages of three partials."""
    apply = quick_jit(network.apply)
    return lambda partial: apply(variables, partial)


def paper(name, *numbers):
    return pytest.param(name, "paper", *numbers, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "size", "stages", "parameters"),
    [
        paper("pcn", (1024, 16384), 6_861_059),
        ("pcn", "small", (128, 2048), 1_127_427),
        paper("fsc", (1024, 16384), 29_650_051),
        ("fsc", "small", (128, 2048), 1_488_307),
        paper("pointr", (448, 16384), 31_276_806),
        ("pointr", "small", (192, 2048), 980_342),
        paper("seedformer", (256, 512, 2048, 16384), 3_308_620),
        ("seedformer", "small", (128, 256, 2048), 634_089),
    ],
)
def test_stages_and_parameters(name, size, stages, parameters):
    """Of the authors' releases, but for what never runs there."""
    network = NETWORKS[name][size]
    config = network.config
    partial = jnp.zeros((2, config.num_points, 3))
    made, variables = jax.eval_shape(
        lambda: network.init_with_output(jax.random.key(0), partial)
    )
    assert [stage.shape for stage in made] == [(2, n, 3) for n in stages]
    assert config.num_outputs == stages[-1]
    found = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    assert found == parameters
    assert ("batch_stats" in variables) == getattr(config, "use_norm", False)


def test_the_order_of_points_is_free_but_for_the_first(complete_fn, clouds):
    partial = clouds[0]
    order = np.concatenate([[0], 1 + RNG.permutation(partial.shape[1] - 1)])
    expected, shuffled = complete_fn(partial), complete_fn(partial[:, order])
    for a, b in zip(expected[:-1], shuffled[:-1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    # PoinTr appends the partial as it comes.
    a, b = (np.sort(stages[-1], axis=1) for stages in (expected, shuffled))
    np.testing.assert_allclose(a, b, atol=1e-5)
    moved = complete_fn(partial + 0.5)
    assert np.abs(moved[0] - expected[0]).max() > 1e-3


@pytest.mark.slow
def test_a_batch_is_its_clouds(network, complete_fn, variables, clouds, quick_jit):
    """Mapped, alone, and with another leading axis."""
    together = complete_fn(clouds[0])
    apply = quick_jit(network.apply)
    mapped = quick_jit(jax.vmap(network.apply, (None, 0)))(variables, clouds[0])
    nested = apply(variables, clouds[0][:, None])
    alone = [apply(variables, cloud) for cloud in clouds[0]]
    for i, stage in enumerate(together):
        np.testing.assert_allclose(mapped[i], stage, atol=1e-5)
        np.testing.assert_allclose(nested[i][:, 0], stage, atol=1e-5)
        np.testing.assert_allclose([one[i] for one in alone], stage, atol=1e-5)


@pytest.mark.slow
def test_gradients_reach_every_parameter(loss_and_grad, variables, clouds):
    (loss, _), grads = loss_and_grad(variables["params"], *clouds)
    assert np.isfinite(loss)
    for name, leaf in flatten_dict(grads, sep="/").items():
        assert np.isfinite(leaf).all(), name
        largest = np.abs(leaf).max()
        unseen = name.endswith(UNSEEN) and not name.startswith("seed_generator")
        assert largest < 1e-5 if unseen else largest > 0, name


def degenerate(points):
    """Of one point, at the origin, collinear and far away."""
    yield np.broadcast_to(points[:1, :1], points.shape)
    yield 0 * points
    yield points[..., :1] * np.float32([1, 2, -1])
    yield points + 1e3


def test_degenerate_clouds_stay_finite(complete_fn, clouds):
    for partial in degenerate(np.array(clouds[0])):
        assert all(np.isfinite(stage).all() for stage in complete_fn(partial))


@pytest.mark.slow
def test_and_so_do_their_gradients(loss_and_grad, variables, clouds):
    for partial in degenerate(np.array(clouds[0])):
        found = loss_and_grad(variables["params"], partial, clouds[1])
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_a_cloud_of_no_points_is_refused(network, variables):
    with pytest.raises(ValueError, match=r"empty cloud|made for"):
        jax.eval_shape(network.apply, variables, jnp.zeros((1, 0, 3)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fsc", "pointr", "seedformer"])
def test_training_moves_the_statistics_and_nothing_else_does(name, quick_jit):
    config = TINY[name].config
    network = type(TINY[name])(dataclasses.replace(config, use_norm=True))
    partial = jnp.asarray(RNG.normal(size=(3, config.num_points, 3)), jnp.float32)
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
