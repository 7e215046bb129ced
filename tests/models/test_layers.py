"""Pointwise layers against NumPy, and against PyTorch where it is installed."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from prism_jax.geometry import kernels
from prism_jax.models.layers import (
    MLP,
    Conv,
    Dense,
    ResidualMLP,
    SplitPoints,
    batch_norm,
    gather,
    highest,
    over_batch,
    repeat_in_place,
    take,
)

RNG = np.random.default_rng(0)


def normal(*shape):
    """Single precision, or double in the tests of gradients."""
    return jnp.asarray(RNG.normal(size=shape), jnp.result_type(float))


def randomised(module, *inputs):
    """Variables of the module, biases included, drawn anew."""
    tree = jax.eval_shape(lambda: module.init(jax.random.key(0), *inputs))
    return jax.tree.map(lambda leaf: normal(*leaf.shape), tree)


def dense(x, params):
    return np.asarray(x) @ np.asarray(params["kernel"]) + np.asarray(params["bias"])


def test_gather_and_take_pick_rows_of_each_cloud():
    features = normal(2, 3, 5, 4)
    many = RNG.integers(0, 5, (2, 3, 7, 2))
    gathered = np.asarray(jax.jit(gather)(features, many))
    taken = np.asarray(jax.jit(take)(features, many[..., 0]))
    assert gathered.shape == (2, 3, 7, 2, 4)
    for cloud in np.ndindex(2, 3):
        for row in range(7):
            np.testing.assert_array_equal(
                gathered[cloud][row], features[cloud][many[cloud][row]]
            )
            np.testing.assert_array_equal(
                taken[cloud][row], features[cloud][many[cloud][row, 0]]
            )


@pytest.mark.parametrize("shape", [(5, 3), (1, 2), (2, 4, 8, 3)])
def test_highest_is_the_maximum_and_so_is_its_derivative(shape):
    features, weights = normal(*shape), normal(*shape[:-2], shape[-1])
    np.testing.assert_array_equal(jax.jit(highest)(features), features.max(-2))
    derivatives = [
        jax.grad(lambda x, pool=pool: (pool(x) ** 2 * weights).sum())(features)
        for pool in (highest, lambda x: x.max(-2))
    ]
    np.testing.assert_array_equal(*derivatives)


def test_of_equal_points_the_first_has_the_derivative():
    gradient = jax.grad(lambda x: highest(x).sum())(jnp.array([[1.0], [2.0], [2.0]]))
    np.testing.assert_array_equal(gradient[:, 0], [0, 1, 0])


def test_highest_of_what_is_not_a_number_is_none():
    points = jnp.array([[1.0, 3.0], [jnp.nan, -jnp.inf]])
    np.testing.assert_array_equal(highest(points), [jnp.nan, 3.0])


def test_the_derivative_of_highest_divides_by_nothing():
    """What `jnp.max` divides by can be zero, when compiled."""
    for pool, divides in ((highest, False), (lambda x: x.max(-2), True)):
        twice = jax.grad(
            lambda x, f=pool: (jax.grad(lambda y: (f(y) ** 3).sum())(x)).sum()
        )
        assert ("div" in str(jax.make_jaxpr(twice)(jnp.ones((4, 2))))) == divides


def test_gather_gives_each_row_a_gradient_per_use():
    indices = np.array([[0, 0, 2], [2, 0, 3]])
    gradient = jax.grad(lambda f: gather(f, indices).sum())(jnp.zeros((5, 1)))
    np.testing.assert_array_equal(gradient[:, 0], [3, 0, 2, 1, 0])


def test_over_batch_maps_every_leading_axis():
    fn = over_batch(lambda cloud, offset: (cloud - offset).sum(-1))
    clouds, offsets = normal(2, 3, 5, 3), normal(2, 3, 1, 3)
    mapped = jax.jit(fn)(clouds, offsets)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(mapped[i], fn(clouds[i], offsets[i]), rtol=1e-6)
    assert fn(clouds[0, 0], offsets[0, 0]).shape == (5,)


def test_linear_adds_up_to_a_dense_layer():
    x, y = normal(5, 4), normal(5, 4)
    module = Dense(3)
    variables = randomised(module, x)
    both = module.apply(variables, x) + module.apply(variables, y, bias=False)
    expected = nn.Dense(3).apply(variables, x + y)
    np.testing.assert_allclose(both, expected, rtol=1e-5, atol=1e-5)


def test_joined_dense_is_a_dense_layer_of_the_concatenation():
    parts = [normal(2, 6, 4), normal(2, 3, 5), normal(2, 1, 2)]
    module = MLP((3,))
    variables = randomised(module, *parts)
    joined = [np.repeat(part, 6 // part.shape[1], axis=1) for part in parts]
    expected = dense(np.concatenate(joined, -1), variables["params"]["dense_0"])
    actual = jax.jit(module.apply)(variables, *parts)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)
    mapped = jax.vmap(lambda *p: module.apply(variables, *p))(*parts)
    np.testing.assert_allclose(mapped, expected, rtol=1e-5, atol=1e-5)


def test_mlp_has_no_activation_after_its_last_layer():
    x, y = normal(4, 3), normal(2, 2)
    module = MLP((6, 5, 2))
    variables = randomised(module, x, y)
    params = variables["params"]
    expected = np.concatenate([x, np.repeat(y, 2, 0)], -1)
    for i in range(2):
        expected = np.maximum(dense(expected, params[f"dense_{i}"]), 0)
    expected = dense(expected, params["dense_2"])
    assert (expected < 0).any()
    actual = jax.jit(module.apply)(variables, x, y)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


def test_mlp_initialises_its_last_kernel_as_told():
    module = MLP((6, 2), final_init=nn.initializers.constant(0.25))
    params = module.init(jax.random.key(0), normal(4, 3))["params"]
    assert (params["dense_1"]["kernel"] == 0.25).all()
    assert np.std(params["dense_0"]["kernel"]) > 0.1
    with pytest.raises(ValueError, match="at least one layer"):
        MLP(()).init(jax.random.key(0), normal(4, 3))


def test_residual_mlp():
    x, y = normal(2, 4, 3), normal(2, 4, 2)
    module = ResidualMLP(6, 5)
    variables = randomised(module, x, y)
    params, joined = variables["params"], np.concatenate([x, y], -1)
    hidden = np.maximum(dense(joined, params["dense_0"]), 0)
    expected = dense(hidden, params["dense_1"]) + dense(joined, params["shortcut"])
    actual = jax.jit(module.apply)(variables, x, y)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("times", [1, 3])
def test_repeat_in_place(times):
    x = normal(2, 4, 3)
    repeated = jax.jit(repeat_in_place, static_argnums=1)(x, times)
    assert repeated.shape == (2, 4 * times, 3)
    for row in range(4 * times):
        np.testing.assert_array_equal(repeated[:, row], x[:, row // times])
    gradient = jax.grad(lambda x: repeat_in_place(x, times).sum())(x)
    np.testing.assert_array_equal(gradient, np.full((2, 4, 3), times))


@pytest.mark.parametrize(("times", "bias"), [(1, False), (2, True), (4, False)])
def test_split_points_is_a_transposed_convolution(times, bias):
    x = normal(2, 5, 3)
    module = SplitPoints(6, times, use_bias=bias)
    variables = randomised(module, x)
    params = variables["params"]
    assert ("bias" in params) == bias
    kernel = np.array(params["dense"]["kernel"])
    actual = np.asarray(jax.jit(module.apply)(variables, x))
    assert actual.shape == (2, 5 * times, 6)
    for row in range(5 * times):
        expected = np.asarray(x[:, row // times]) @ kernel[:, row % times]
        expected = expected + (np.asarray(params["bias"]) if bias else 0)
        np.testing.assert_allclose(actual[:, row], expected, rtol=1e-5, atol=1e-5)
    mapped = jax.vmap(lambda x: module.apply(variables, x))(x)
    np.testing.assert_allclose(mapped, actual, rtol=1e-6, atol=1e-6)

    torch = pytest.importorskip("torch")
    weight = torch.from_numpy(kernel.transpose(0, 2, 1).copy())
    expected = torch.nn.functional.conv_transpose1d(
        torch.from_numpy(np.array(x.swapaxes(1, 2))),
        weight,
        torch.from_numpy(np.array(params["bias"])) if bias else None,
        stride=times,
    )
    np.testing.assert_allclose(
        actual, expected.numpy().swapaxes(1, 2), rtol=1e-5, atol=1e-5
    )


class Normed(nn.Module):
    @nn.compact
    def __call__(self, x, train):
        return batch_norm(train)(x)


def test_batch_norm():
    x = 3 * normal(2, 5, 4) + 1
    variables = randomised(Normed(), x, True)
    norm, old = variables["params"]["norm"], variables["batch_stats"]["norm"]
    old = {"mean": old["mean"], "var": np.abs(old["var"])}
    variables = {"params": {"norm": norm}, "batch_stats": {"norm": old}}

    def normalised(mean, var):
        return (x - mean) / np.sqrt(var + 1e-5) * norm["scale"] + norm["bias"]

    actual = Normed().apply(variables, x, False)
    expected = normalised(old["mean"], old["var"])
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)

    actual, new = Normed().apply(variables, x, True, mutable=["batch_stats"])
    mean, var = np.mean(x, (0, 1)), np.var(x, (0, 1))
    np.testing.assert_allclose(actual, normalised(mean, var), rtol=1e-4, atol=1e-5)
    new = new["batch_stats"]["norm"]
    np.testing.assert_allclose(new["mean"], 0.9 * old["mean"] + 0.1 * mean, rtol=1e-5)
    np.testing.assert_allclose(new["var"], 0.9 * old["var"] + 0.1 * var, rtol=1e-5)


def test_batch_norm_of_a_constant_batch_is_finite():
    x = jnp.full((6, 4), 7.0)
    variables = randomised(Normed(), x, True)

    def total(x):
        return Normed().apply(variables, x, True, mutable=["batch_stats"])[0].sum()

    value, gradient = jax.jit(jax.value_and_grad(total))(x)
    bias = variables["params"]["norm"]["bias"]
    np.testing.assert_allclose(value, 6 * bias.sum(), rtol=1e-4, atol=1e-3)
    assert np.isfinite(gradient).all()


def test_statistics_are_not_touched_unless_asked_for():
    x = normal(6, 4)
    variables = randomised(Normed(), x, True)
    with pytest.raises(Exception, match="batch_stats"):
        Normed().apply(variables, x, True)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    "module",
    [MLP((4, 3)), ResidualMLP(4, 3)],
    ids=lambda m: type(m).__name__,
)
def test_gradients(module):
    parts = [normal(4, 3), normal(2, 2)]
    variables = randomised(module, *parts)

    @jax.jit
    def total(variables, *parts):
        return jnp.sin(module.apply(variables, *parts)).sum()

    check_grads(total, (variables, *parts), order=2, modes=["rev"], eps=1e-6)


@pytest.mark.usefixtures("x64")
def test_gradients_of_splitting():
    x, module = normal(4, 3), SplitPoints(3, 2)
    variables = randomised(module, x)

    @jax.jit
    def total(variables, x):
        return jnp.sin(module.apply(variables, x)).sum()

    check_grads(total, (variables, x), order=2, modes=["rev"], eps=1e-6)


def test_conv_for_a_gpu_keeps_its_windows_apart(monkeypatch):
    x, module = normal(2, 8, 8, 3), Conv(4, 3)
    variables = module.init(jax.random.key(0), x)

    def squares(x):
        return (module.apply(variables, x) ** 2).sum()

    expected = jax.value_and_grad(squares)(x)
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    assert "optimization_barrier" in str(jax.make_jaxpr(squares)(x))
    found = jax.value_and_grad(squares)(x)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.parametrize(
    ("size", "strides", "pixels"),
    [
        *((1, 2, (9, 6)), (3, 1, (9, 6)), (3, 2, (9, 6))),
        *((3, 2, (8, 8)), (7, 2, (8, 8))),
    ],
)
def test_conv_is_flax_conv(size, strides, pixels):
    x = normal(2, *pixels, 3)
    module = Conv(4, size, strides)
    oracle = nn.Conv(4, (size, size), strides, use_bias=False)

    @jax.jit
    def everything(x):
        variables = [m.init(jax.random.key(0), x) for m in (module, oracle)]

        def both(apply):
            total = lambda v, x: (apply(v, x) ** 3).sum()  # noqa: E731
            return jax.value_and_grad(total, argnums=(0, 1))(variables[0], x)

        mapped = jax.vmap(lambda x: module.apply(variables[0], x))(x)
        outputs = mapped, oracle.apply(variables[0], x)
        return variables, (both(module.apply), both(oracle.apply)), outputs

    (ours, flax), derivatives, (mapped, expected) = everything(x)
    np.testing.assert_array_equal(ours["params"]["kernel"], flax["params"]["kernel"])
    for a, b in zip(*map(jax.tree.leaves, derivatives), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(mapped, expected, atol=1e-5)
