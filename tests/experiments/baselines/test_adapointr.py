"""AdaPoinTr: what it has beside PoinTr, whose parts `test_pointr.py` looks at."""

import dataclasses

import flax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from scipy.spatial import KDTree

from experiments.baselines.adapointr import (
    ADAPOINTR_SMALL,
    AdaPoinTr,
    AdaPoinTrConfig,
    highest_scored,
    seen_neighbors,
    sight,
)
from experiments.baselines.pointr import Attention
from prism_jax.losses.primary import primary_loss
from prism_jax.models.variables import apply_training

RNG = np.random.default_rng(0)
TINY = AdaPoinTrConfig(
    num_points=64,
    num_centers=(32, 16),
    center_features=(4, 8, 8, 8, 8),
    center_neighbors=4,
    norm_groups=2,
    features=16,
    num_heads=2,
    depth=(1, 1),
    block_neighbors=4,
    position_features=8,
    global_features=16,
    num_queries=8,
    use_norm=False,
    score_features=(6, 6),
    rebuilt_points=4,
    rebuild_features=8,
    num_noised=5,
)
MODEL = AdaPoinTr(TINY)


def normal(*shape, scale=1.0):
    return jnp.asarray(scale * RNG.normal(size=shape), jnp.float32)


PARTIAL = normal(3, 64, 3)
COMPLETE = normal(3, 96, 3)
VARIABLES = jax.tree.map(
    lambda leaf: normal(
        *leaf.shape, scale=(leaf.shape[0] if leaf.ndim > 1 else 100) ** -0.5
    ),
    jax.eval_shape(lambda: MODEL.init(jax.random.key(0), PARTIAL)),
)


def farthest(cloud, count):
    """By the definition, in double precision."""
    cloud = np.float64(cloud)
    distances, rows = np.full(len(cloud), np.inf), [0]
    while len(rows) < count:
        distances = np.minimum(distances, ((cloud - cloud[rows[-1]]) ** 2).sum(-1))
        rows.append(int(distances.argmax()))
    return cloud[rows]


FARTHEST = np.stack([farthest(cloud, 8) for cloud in PARTIAL])


@pytest.fixture(scope="module")
def complete_fn(quick_jit):
    return quick_jit(MODEL.apply)


@pytest.fixture(scope="module")
def step(quick_jit):
    """Adam on the parameters as one vector, and where it starts: ``(vector, state,
    partials, key) -> (rebuilt, denoising, loss, gradient, vector, state)``."""
    vector, unravel = ravel_pytree(VARIABLES)
    optimizer = optax.adam(1e-2)

    def loss(vector, partials, key):
        (stages, own), kept = MODEL.apply(
            unravel(vector),
            partials,
            COMPLETE,
            "l1",
            method="supervised",
            rngs={"noise": key},
            capture_intermediates=lambda _, method: method == "_rebuilt",
        )
        (rebuilt,) = kept["intermediates"]["_rebuilt"]
        primary = jax.vmap(lambda s, c: primary_loss(s, c, "l1"))(stages, COMPLETE)
        return (primary + own[:, 0]).mean(), (rebuilt, own)

    def step(vector, state, partials, key):
        value_and_grad = jax.value_and_grad(loss, has_aux=True)
        (value, made), gradient = value_and_grad(vector, partials, key)
        updates, state = optimizer.update(gradient, state)
        return *made, value, gradient, vector + updates, state

    return quick_jit(step), (vector, optimizer.init(vector))


@pytest.mark.parametrize(
    ("config", "sizes", "parameters"),
    [
        (AdaPoinTrConfig(), (512, 16_384), 32_405_953),
        (ADAPOINTR_SMALL, (128, 2048), 1_018_177),
    ],
    ids=["published", "small"],
)
def test_sizes_and_parameters(config, sizes, parameters):
    partial = jax.ShapeDtypeStruct((2, config.num_points, 3), jnp.float32)
    module = AdaPoinTr(config)
    stages, variables = jax.eval_shape(
        lambda p: module.init_with_output(jax.random.key(0), p), partial
    )
    assert tuple(stage.shape for stage in stages) == tuple((2, n, 3) for n in sizes)
    assert config.stage_sizes == sizes and config.num_outputs == sizes[-1]
    leaves = jax.tree.leaves(variables["params"])
    assert sum(leaf.size for leaf in leaves) == parameters
    assert ("batch_stats" in variables) == config.use_norm


def test_the_highest_scores_are_chosen(quick_jit):
    choose = quick_jit(highest_scored, static_argnums=2)
    candidates, scores = normal(2, 12, 3), normal(2, 12)
    chosen, found = choose(candidates, scores, 5)
    for i in range(2):
        rows = np.argsort(-np.asarray(scores[i]), kind="stable")[:5]
        np.testing.assert_array_equal(chosen[i], candidates[i, rows])
        np.testing.assert_array_equal(found[i], scores[i, rows])
    first, _ = choose(candidates, jnp.zeros((2, 12)), 5)
    np.testing.assert_array_equal(first, candidates[:, :5])
    slopes = quick_jit(
        jax.grad(lambda s: (highest_scored(candidates, s, 5)[1] ** 2).sum())
    )(scores)
    assert ((slopes != 0).sum(-1) == 5).all()


def test_queries_come_from_the_partial_and_from_the_global_feature(complete_fn):
    """With scores that grow along x, and predicted centres all at the origin."""
    changed = jax.tree.map(lambda leaf: leaf, VARIABLES)
    params = changed["params"]
    params["centers"] = jax.tree.map(np.zeros_like, params["centers"])
    scores = jax.tree.map(np.zeros_like, params["scores"])
    scores["dense_0"]["kernel"][0, :2] = [1, -1]
    scores["dense_1"]["kernel"][[0, 1], [0, 1]] = 1
    scores["dense_2"]["kernel"][:2, 0] = [1, -1]
    params["scores"] = scores
    coarse, _ = complete_fn(changed, PARTIAL)
    for i in range(3):
        seen = np.float32(FARTHEST[i, :4])
        candidates = np.concatenate([np.zeros((8, 3), np.float32), seen])
        rows = np.argsort(-candidates[:, 0], kind="stable")[:8]
        np.testing.assert_array_equal(coarse[i], candidates[rows])
    assert (np.abs(coarse).max(-1) > 0).any() and (np.abs(coarse).max(-1) == 0).any()


def test_queries_do_not_see_the_noised(quick_jit):
    found = np.asarray(sight(3, 2))
    expected = np.ones((5, 5), bool)
    expected[:3, 3:] = False
    np.testing.assert_array_equal(found, expected)
    centers = normal(12, 3)
    near = np.asarray(quick_jit(seen_neighbors, static_argnums=(1, 2))(centers, 8, 4))
    queries, noised = KDTree(centers[:8]), KDTree(centers)
    np.testing.assert_array_equal(near[:8], queries.query(centers[:8], 4)[1])
    np.testing.assert_array_equal(near[8:], noised.query(centers[8:], 4)[1])


def test_attention_to_what_is_visible_is_attention_to_that_alone(quick_jit):
    query, support, module = normal(5, 12), normal(7, 12), Attention(3)
    variables = module.init(jax.random.key(0), query, support)
    visible = jnp.broadcast_to(jnp.arange(7) < 4, (5, 7))
    apply = quick_jit(module.apply)
    found = apply(variables, query, support, visible)
    expected = apply(variables, query, support[:4])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_denoising_is_in_training_alone_and_changes_no_completion(complete_fn, step):
    fn, start = step
    plain = complete_fn(VARIABLES, PARTIAL)
    # Without any noise to draw, and asked to train: the task is `supervised`'s alone.
    trained = jax.eval_shape(lambda: MODEL.apply(VARIABLES, PARTIAL, train=True))
    assert [stage.shape for stage in trained] == [stage.shape for stage in plain]
    given = (VARIABLES, PARTIAL, COMPLETE, "l1")
    with pytest.raises(flax.errors.InvalidRngError):
        jax.eval_shape(lambda: MODEL.apply(*given, method="supervised"))
    first, other = (fn(*start, PARTIAL, jax.random.key(seed))[0] for seed in (0, 1))
    assert np.abs(other.denoised - first.denoised).max() > 1e-3
    for rebuilt in (first, other):
        for stage, expected in zip(rebuilt[:2], plain, strict=True):
            np.testing.assert_allclose(stage, expected, atol=1e-5)


def test_what_is_denoised_is_compared_with_what_is_nearest(step):
    """And half as much of it counts."""
    fn, start = step
    rebuilt, losses, *_ = fn(*start, PARTIAL, jax.random.key(0))
    assert losses.shape == (3, 1) and rebuilt.denoised.shape == (3, 20, 3)
    for i in range(3):
        complete, denoised = np.float64(COMPLETE[i]), np.float64(rebuilt.denoised[i])
        rows = KDTree(complete).query(rebuilt.noised[i], 4)[1].reshape(-1)
        there = KDTree(complete[rows]).query(denoised)[0].mean()
        back = KDTree(denoised).query(complete[rows])[0].mean()
        expected = 0.5 * (0.5 * (there + back))
        assert float(losses[i, 0]) == pytest.approx(expected, rel=1e-4)


def test_noise_is_small_drawn_anew_and_the_same_again(step):
    fn, start = step
    first, again, other = (
        np.asarray(fn(*start, PARTIAL, jax.random.key(seed))[0].noised)
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    noise = first - FARTHEST[:, :5]
    assert np.abs(noise).max() < 0.05 + 1e-6
    assert noise.std() == pytest.approx(0.01, rel=0.35)  # of 45 numbers
    assert (first != other).all()


def test_points_are_rebuilt_around_their_centres(complete_fn):
    """On them, without a last layer."""
    flat = jax.tree.map(lambda leaf: leaf, VARIABLES)
    head = flat["params"]["rebuild"]
    head["dense_1"] = jax.tree.map(np.zeros_like, head["dense_1"])
    coarse, dense = complete_fn(flat, PARTIAL)
    np.testing.assert_array_equal(dense, np.repeat(coarse, 4, axis=1))


def test_order_of_the_points_does_not_matter_after_the_first(complete_fn):
    order = np.concatenate([[0], 1 + RNG.permutation(63)])
    expected = complete_fn(VARIABLES, PARTIAL)
    for stage, same in zip(
        complete_fn(VARIABLES, PARTIAL[:, order]), expected, strict=True
    ):
        np.testing.assert_allclose(stage, same, atol=1e-5)
    moved, _ = complete_fn(VARIABLES, PARTIAL + 0.1)
    assert np.abs(moved - expected[0]).max() > 1e-3


def test_gradients_reach_every_parameter(step):
    """The scores among them."""
    fn, start = step
    _, unravel = ravel_pytree(VARIABLES)
    gradient = unravel(fn(*start, PARTIAL, jax.random.key(0))[3])
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0, path


def test_degenerate_clouds_stay_finite(step):
    fn, start = step
    line = PARTIAL[0, :, :1] * np.float32([1, 2, -1])
    identical = np.broadcast_to(PARTIAL[0, :1], (64, 3))
    clouds = np.stack([identical, line, PARTIAL[0] + 1000.0])
    _, own, value, gradient, _, _ = fn(*start, clouds, jax.random.key(0))
    assert np.isfinite(own).all() and np.isfinite(value)
    assert np.isfinite(gradient).all()


def test_a_few_steps_lower_the_loss(step):
    fn, (vector, state) = step
    losses = []
    for i in range(10):
        _, _, value, _, vector, state = fn(vector, state, PARTIAL, jax.random.key(i))
        losses.append(float(value))
    assert losses[-1] < 0.9 * losses[0]


def test_it_has_what_a_training_asks_for():
    """As `network_phase` calls it."""
    (stages, losses), statistics = jax.eval_shape(
        lambda: apply_training(
            MODEL,
            VARIABLES,
            PARTIAL,
            COMPLETE,
            "l1",
            method="supervised",
            rngs={"noise": jax.random.key(0)},
        )
    )
    assert statistics == {} and losses.shape == (3, len(MODEL.own_losses))
    assert [stage.shape[1] for stage in stages] == [*TINY.stage_sizes]


@pytest.mark.slow
def test_batch_vmap_and_training_mode_agree(complete_fn, quick_jit):
    batch = complete_fn(VARIABLES, PARTIAL)
    mapped = quick_jit(jax.vmap(MODEL.apply, (None, 0)))(VARIABLES, PARTIAL)
    trained = quick_jit(lambda v, p: MODEL.apply(v, p, train=True))(VARIABLES, PARTIAL)
    for stage, *others in zip(batch, mapped, trained, strict=True):
        for other in others:
            np.testing.assert_allclose(stage, other, atol=1e-5)


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="64 points"):
        MODEL.apply(VARIABLES, PARTIAL[:, :63])
    with pytest.raises(ValueError, match="centers"):
        dataclasses.replace(TINY, num_queries=33)
    with pytest.raises(ValueError, match="noised"):
        dataclasses.replace(TINY, num_noised=33)
