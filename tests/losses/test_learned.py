"""What a learned loss looks at: scipy's neighbours, closed forms, finite differences,
and clouds that fall together."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.geometry.visibility import clues, nothing_known, seen_by
from prism_jax.losses.learned import FLOOR, MIDDLE, NAMES, REACH, error_clues

EYE = jnp.array([2.5, 0.4, 1.0])


def cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(-0.7, 0.7, (count, 3)), jnp.float32)


@pytest.fixture(scope="module")
def partial():
    return cloud(40, 1)


@pytest.fixture(scope="module")
def known(partial):
    return see(partial, EYE, "empty")


looked = jax.jit(error_clues)
see = jax.jit(seen_by, static_argnums=2)


def named(found):
    return dict(zip(NAMES, np.asarray(found).T, strict=True))


def test_they_are_what_their_names_say(partial, known):
    points = cloud(60)
    found = named(looked(points, partial, known, EYE))
    points, partial = np.asarray(points), np.asarray(partial)

    def logarithm(apart):
        return 0.5 * np.log(apart**2 + FLOOR**2) - MIDDLE

    close = functools.partial(np.testing.assert_allclose, atol=2e-5)
    away = KDTree(partial).query(points, k=8)[0]
    close(found["measured"], logarithm(away[:, 0]))
    close(found["measured_8"], logarithm(away[:, 7]))
    apart, rows = KDTree(points).query(points, k=9)
    close(found["predicted"], logarithm(apart[:, 1]))
    close(found["predicted_8"], logarithm(apart[:, 8]))
    bulge = np.linalg.norm(points - points[rows[:, 1:]].mean(1), axis=1)
    close(found["bulge"], logarithm(bulge))
    names = ("unknown", "surface", "nearer", "background", "behind", "aside")
    close(np.stack([found[n] for n in names], 1), clues(known, jnp.asarray(points)))
    close(np.stack([found[n] for n in "xyz"], 1), points)
    close(found["centre"], np.hypot(np.linalg.norm(points, axis=1), FLOOR))
    beyond = points - np.clip(points, partial.min(0), partial.max(0))
    assert (beyond != 0).any() and (beyond == 0).all(1).any()
    close(found["outside"], np.hypot(np.linalg.norm(beyond, axis=1), FLOOR))
    ray = points - np.asarray(EYE)
    close(found["range"], np.hypot(np.linalg.norm(ray, axis=1), FLOOR))
    rays = np.stack([found[f"ray_{n}"] for n in "xyz"], 1)
    close(rays, ray / found["range"][:, None])
    spacing = np.median(KDTree(partial).query(partial, k=2)[0][:, 1])
    close(found["spacing"], logarithm(spacing))


def test_gradient_against_finite_differences(x64, partial):
    points = jnp.asarray(cloud(30), float)
    partial = jnp.asarray(partial, float)
    known = see(partial, EYE, "empty")
    rng = np.random.default_rng(2)
    along, weights = (
        jnp.asarray(rng.normal(size=s)) for s in ((30, 3), (30, len(NAMES)))
    )

    @jax.jit
    def value(points):
        return (weights * error_clues(points, partial, known, EYE)).sum()

    step = 1e-7
    slope = (value(points + step * along) - value(points - step * along)) / (2 * step)
    gradient = jax.grad(value)(points)
    np.testing.assert_allclose((gradient * along).sum(), slope, rtol=1e-5)


HARD = {
    "copies": jnp.zeros((20, 3)),
    "one point": jnp.full((1, 3), 0.2),
    "measured points": cloud(40, 1)[:20],
    "at the sensor": jnp.tile(EYE, (20, 1)),
    "behind the sensor": jnp.full((20, 3), 3.0),
    "not finite": cloud(20).at[3, 1].set(jnp.nan).at[4].set(jnp.inf),
    "beyond all bounds": cloud(20).at[5].set(1e30),
}


@jax.jit
def derivatives(points, partial, known):
    """Of the sum of all squared clues: the first, and the second along ones."""

    def value(points):
        return (error_clues(points, partial, known, EYE) ** 2).sum()

    return jax.jvp(jax.grad(value), (points,), (jnp.ones_like(points),))


@pytest.mark.parametrize("points", HARD.values(), ids=HARD)
@pytest.mark.parametrize("blind", [False, True])
def test_every_derivative_is_finite(partial, known, points, blind):
    """With the second, which the unrolled steps ask for, and where nothing is known."""
    known = nothing_known() if blind else known
    assert np.isfinite(looked(points, partial, known, EYE)).all()
    found, curved = derivatives(points, partial, known)
    assert np.isfinite(found).all() and np.isfinite(curved).all()
    beyond = ~(np.abs(points) <= REACH)
    assert (np.asarray(found)[beyond] == 0).all()


def test_a_single_measured_point(known):
    partial = jnp.zeros((1, 3))
    gradient = jax.grad(lambda p: looked(p, partial, known, EYE).sum())(partial)
    assert np.isfinite(gradient).all()


def test_no_gradient_but_in_the_points(partial, known):
    points = cloud(20)

    @jax.jit
    def value(partial, eye):
        known = seen_by(partial, eye, "empty")
        return error_clues(points, partial, known, eye).sum()

    for found in jax.grad(value, (0, 1))(partial, EYE):
        assert (np.asarray(found) == 0).all()


def test_mapped_over_clouds_it_is_the_same(partial, known):
    clouds = jnp.stack([cloud(20, 3), cloud(20, 4)])
    together = jax.vmap(looked, (0, None, None, None))(clouds, partial, known, EYE)
    for one, each in zip(clouds, together, strict=True):
        np.testing.assert_allclose(each, looked(one, partial, known, EYE), atol=1e-5)
