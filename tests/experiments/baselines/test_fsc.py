"""FSC against its formulas, and what its authors' release says of it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.distance import cdist

from experiments.baselines.fsc import FSC, FSC_SMALL, FSCConfig, OffsetAttention
from prism_jax.losses.primary import primary_loss

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
COMPLETE = jnp.asarray(RNG.uniform(-1, 1, (3, 32, 3)), jnp.float32)

DEGENERATE = {
    "one point many times": np.tile([[0.3, -0.2, 0.7]], (24, 1)),
    "one point": np.array([[0.3, -0.2, 0.7]]),
    "all at the origin": np.zeros((24, 3)),
    "collinear": np.linspace(-1, 1, 24)[:, None] * [1.0, 2.0, -1.0],
    "far from the origin": RNG.uniform(-1, 1, (24, 3)) + 1e4,
}


@pytest.fixture(scope="module")
def variables():
    """With biases that are not zero."""
    fresh = jax.jit(FSC(TINY).init)(jax.random.key(0), PARTIAL)
    return jax.tree.map(lambda leaf: leaf + 0.1 * (leaf.ndim == 1), fresh)


@pytest.fixture(scope="module")
def complete_fn(quick_jit):
    return quick_jit(FSC(TINY).apply)


@pytest.fixture(scope="module")
def loss_and_grad(quick_jit):
    """Eq. 10 over a batch, and its gradient in the variables."""

    def loss(variables, partial, complete):
        stages = FSC(TINY).apply(variables, partial)
        return jax.vmap(primary_loss)(stages, complete).mean()

    return quick_jit(jax.value_and_grad(loss))


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


@pytest.mark.parametrize(
    ("config", "stages"),
    [(FSCConfig(), (1024, 16384)), (FSC_SMALL, (128, 2048)), (TINY, (8, 32))],
)
def test_points_of_every_stage(config, stages):
    partial = jax.ShapeDtypeStruct((2, config.num_points, 3), jnp.float32)
    make = functools.partial(FSC(config).init_with_output, train=True)
    made, _ = jax.eval_shape(make, jax.random.key(0), partial)
    assert [stage.shape for stage in made] == [(2, n, 3) for n in stages]
    assert config.num_outputs == stages[-1]
    assert hash(config) == hash(FSCConfig(**vars(config)))


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
    assert count(FSCConfig()) == total == 29_650_051
    assert count(FSC_SMALL) == 1_488_307


def count(config):
    partial = jax.ShapeDtypeStruct((1, config.num_points, 3), jnp.float32)
    variables = jax.eval_shape(FSC(config).init, jax.random.key(0), partial)
    assert ("batch_stats" in variables) == config.use_norm
    return sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))


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


def test_children_stand_around_their_coarse_point(complete_fn, variables):
    """And where nothing is folded, upon it."""
    flat = jax.tree_util.tree_map_with_path(
        lambda path, leaf: 0 * leaf if "fold_end" in str(path) else leaf, variables
    )
    coarse, fine = complete_fn(flat, PARTIAL)
    assert np.array_equal(fine, np.repeat(coarse, 4, axis=1))


def test_order_of_the_points_does_not_matter(complete_fn, variables):
    expected = complete_fn(variables, PARTIAL)
    order = np.random.default_rng(1).permutation(24)
    for a, b in zip(complete_fn(variables, PARTIAL[:, order]), expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    changed = complete_fn(variables, PARTIAL.at[:, 0].add(0.5))
    assert np.abs(np.asarray(changed[1]) - np.asarray(expected[1])).max() > 1e-3


def test_gradients_reach_every_parameter(loss_and_grad, variables):
    _, grads = loss_and_grad(variables, PARTIAL, COMPLETE)
    for leaf in jax.tree.leaves(grads):
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() > 0


@pytest.mark.usefixtures("x64")
def test_gradients_are_those_of_finite_differences(quick_jit, variables):
    """Along random directions, of a smooth function of both stages."""
    double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), variables)
    partial = jnp.asarray(PARTIAL, jnp.float64)

    @quick_jit
    @jax.value_and_grad
    def loss(variables):
        return sum(jnp.sin(3 * s).sum() for s in FSC(TINY).apply(variables, partial))

    _, grads = loss(double)
    rng, step = np.random.default_rng(2), 1e-7
    for _ in range(3):
        direction = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), double)
        ends = [
            loss(jax.tree.map(lambda x, d, h=h: x + h * d, double, direction))[0]
            for h in (step, -step)
        ]
        slope = sum(
            (g * d).sum()
            for g, d in zip(*map(jax.tree.leaves, (grads, direction)), strict=True)
        )
        difference = float(ends[0] - ends[1]) / (2 * step)
        assert difference == pytest.approx(float(slope), rel=1e-4)


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_clouds(name, complete_fn, loss_and_grad, variables):
    cloud = np.resize(DEGENERATE[name], (24, 3))
    partial = jnp.asarray(np.stack([cloud] * 3), jnp.float32)
    for stage in complete_fn(variables, partial):
        assert np.isfinite(stage).all()
    loss, grads = loss_and_grad(variables, partial, COMPLETE)
    assert np.isfinite(loss)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


def test_a_cloud_of_no_points(variables):
    with pytest.raises(ValueError, match="empty cloud"):
        jax.eval_shape(FSC(TINY).apply, variables, PARTIAL[:, :0])


def test_any_leading_axes(complete_fn, quick_jit, variables):
    """As a batch, mapped, one by one and folded into two axes, it is all the same."""
    together = complete_fn(variables, PARTIAL)
    mapped = quick_jit(jax.vmap(functools.partial(FSC(TINY).apply, variables)))(PARTIAL)
    nested = complete_fn(variables, PARTIAL.reshape(3, 1, 24, 3))
    alone = [complete_fn(variables, cloud) for cloud in PARTIAL]
    for i, stage in enumerate(together):
        np.testing.assert_allclose(mapped[i], stage, atol=1e-5)
        np.testing.assert_allclose(nested[i][:, 0], stage, atol=1e-5)
        for stages, expected in zip(alone, stage, strict=True):
            np.testing.assert_allclose(stages[i], expected, atol=1e-5)


def test_batch_norm_learns_in_training_alone(quick_jit):
    """Its statistics are of the batch in training, and those that it kept without."""
    module = FSC(FSCConfig(**{**vars(TINY), "use_norm": True}))
    variables = jax.jit(module.init)(jax.random.key(0), PARTIAL)
    train = quick_jit(
        functools.partial(module.apply, train=True, mutable=["batch_stats"])
    )
    stages, changed = train(variables, PARTIAL)
    plain = module.apply(variables, PARTIAL)
    assert np.abs(stages[1] - plain[1]).max() > 1e-3
    before, after = (jax.tree.leaves(v["batch_stats"]) for v in (variables, changed))
    assert all(np.abs(a - b).max() > 0 for a, b in zip(before, after, strict=True))


@pytest.mark.slow
def test_some_steps_of_adam_lower_the_loss(loss_and_grad, quick_jit, variables):
    optimizer = optax.adam(3e-3)
    update = quick_jit(optimizer.update)
    state, losses = optimizer.init(variables), []
    for _ in range(20):
        loss, grads = loss_and_grad(variables, PARTIAL, COMPLETE)
        losses.append(float(loss))
        updates, state = update(grads, state)
        variables = optax.apply_updates(variables, updates)
    assert losses[-1] < 0.8 * losses[0]
