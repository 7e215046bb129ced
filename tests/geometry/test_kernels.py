"""The GPU's kernels, interpreted where there is none, against the XLA forms on hard
clouds; their translation to Triton, which needs no GPU."""

import contextlib
import functools

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry import kernels
from prism_jax.geometry.neighbors import knn, nearest
from prism_jax.geometry.sampling import farthest_point_sample
from tests.geometry.test_neighbors import KINDS, of_kind, squared

RNG = np.random.default_rng(0)

INTERPRETED = not kernels.on_gpu()


def on_cpu():
    return jax.default_device(jax.devices("cpu")[0])


def by_xla(fn, *static):
    """A search on the CPU, where no kernel takes its place."""
    return on_cpu()(jax.jit(fn, static_argnums=static))


nearest = by_xla(nearest)
knn = by_xla(knn, 2)
farthest_point_sample = by_xla(farthest_point_sample, 1, 3)
nearest_indices = jax.jit(kernels.nearest_indices)
knn_indices = jax.jit(kernels.knn_indices, static_argnums=(2, 3))
farthest_indices = jax.jit(kernels.farthest_indices, static_argnums=(3, 4))


def cloud(kind: str, count: int) -> jax.Array:
    return jnp.asarray(of_kind(kind, RNG.uniform(-1, 1, (count, 3))))


@pytest.mark.parametrize("sizes", [(130, 70, 8), (1, 1, 1)])
def test_neighbors(sizes):
    *counts, k = sizes
    for kind in (*KINDS, "planar"):
        query, support = (cloud(kind, count) for count in counts)
        for expected, found in (
            (nearest(query, support)[1], nearest_indices(query, support)),
            (knn(query, support, k), knn_indices(query, support, k, INTERPRETED)),
        ):
            assert found.shape == expected.shape
            both = (np.asarray(i).reshape(len(query), -1) for i in (found, expected))
            found_apart, apart = (squared(query, support, i) for i in both)
            np.testing.assert_allclose(found_apart, apart, rtol=1e-5, atol=1e-12)
            # Ties go to the lowest index, where squares are exact on any compiler.
            if kind == "grid":
                np.testing.assert_array_equal(found, expected)
        assert all(len(set(row)) == k for row in np.asarray(found).tolist())


def test_knn_keeps_ties_in_order_when_a_nearer_point_comes():
    query = jnp.zeros((1, 3))
    support = jnp.array([[1.0, 0, 0], [-1, 0, 0], [0.5, 0, 0], [0, 1, 0]])
    found = knn_indices(query, support, 4, INTERPRETED)
    np.testing.assert_array_equal(found, [[2, 0, 1, 3]])


@pytest.mark.parametrize("skip", [False, True])
def test_farthest_points(skip):
    for kind in (*KINDS, "planar"):
        points = cloud(kind, 70)
        expected = farthest_point_sample(points, 20, 3, skip)
        allowed = (points**2).sum(-1) > (1e-3 if skip else -1.0)
        found = farthest_indices(points, allowed, jnp.int32(3), 20, INTERPRETED)
        np.testing.assert_array_equal(found, expected)


def test_vmap_is_a_loop():
    queries, supports = (cloud("gaussian", 120).reshape(3, 40, 3),) * 2
    search = functools.partial(kernels.knn_indices, k=4, interpret=INTERPRETED)
    mapped = jax.vmap(search)(queries, supports + 0.1)
    for i in range(3):
        np.testing.assert_array_equal(mapped[i], search(queries[i], supports[i] + 0.1))


@pytest.mark.parametrize("is_x64", [False, True])
@pytest.mark.parametrize("name", ["knn", "farthest"])
def test_translates_to_triton(name, is_x64):
    functions = {
        "knn": functools.partial(kernels.knn_indices, k=16),
        "farthest": functools.partial(kernels.farthest_indices, num_samples=64),
    }
    shapes = [jax.ShapeDtypeStruct((2, 300, 3), jnp.float32)] * 2
    if name == "farthest":
        shapes[1] = jax.ShapeDtypeStruct((2, 300), jnp.bool_)
        shapes.append(jax.ShapeDtypeStruct((2,), jnp.int32))
    checks = [jax.export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")]
    with jax.enable_x64(is_x64):
        batched = jax.jit(jax.vmap(functions[name], (0,) * len(shapes)))
        export = jax.export.export
        exported = export(batched, platforms=["cuda"], disabled_checks=checks)
        with for_a_gpu():
            assert "triton" in exported(*shapes).mlir_module()


def for_a_gpu():
    """Newer versions of JAX ask which one, where none is at hand."""
    if jax.__version_info__ < (0, 11) or kernels.on_gpu():
        return contextlib.nullcontext()
    device = jax.sharding.AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    return jax.sharding.use_abstract_mesh(mesh)


@on_cpu()
def test_the_platform_chooses(monkeypatch):
    def double(x):
        return 2 * x

    def triple(x):
        return 3 * x

    assert kernels.by_platform(double, triple, jnp.float32(1)) == 3
    # As on a machine with a GPU, for a computation on its CPU.
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    chosen = jax.jit(lambda x: kernels.by_platform(double, triple, x))
    assert chosen(jnp.float32(1)) == 3
    lowered = jax.export.export(chosen, platforms=["cuda"])(jnp.float32(1))
    assert "2.0" in lowered.mlir_module() and "3.0" not in lowered.mlir_module()
