"""Operations against well-known implementations, and against plain `jax.numpy`."""

import functools
import importlib
from collections.abc import Iterator
from typing import Any

import fpsample
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from experiments.benchmarks.measure import Compiled, Row, in_turn, row
from prism_jax.geometry.neighbors import nearest
from prism_jax.geometry.normals import pca_normals
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.geometry.transport import sinkhorn
from prism_jax.losses.chamfer import chamfer

SIZES = (1024, 4096, 16384, 65536)
TARGET_SIZE = 16384
LARGEST_DENSE = 16384
"""Peers that hold a whole matrix of distances are measured up to here."""


def suite() -> Iterator[Row]:
    """Every operation at every size."""
    for size in SIZES:
        points, other = cloud(size, 0), cloud(size, 1)
        for measure in (_nearest, _farthest, _chamfer, _normals):
            yield from measure(points, other)
    for size in (256, 1024, 4096):
        yield from _sinkhorn(size)


def cloud(size: int, seed: int) -> np.ndarray:
    """Points on a bumpy sphere: a surface, as scans are."""
    rng = np.random.default_rng([size, seed])
    points = rng.normal(size=(size, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    radius = 1 + 0.2 * np.sin(5 * points).prod(axis=1, keepdims=True)
    return (radius * points).astype(np.float32)


def _target(size: int, target: float) -> float | None:
    return target if size == TARGET_SIZE else None


def _optional(name: str) -> Any | None:
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"{name} is not installed: its rows are skipped", flush=True)
        return None


def _nearest(points: np.ndarray, other: np.ndarray) -> Iterator[Row]:
    def both(search, a, b):
        return search(a, b), search(b, a)

    def plain(a, b):
        squared = ((a[:, None] - b[None]) ** 2).sum(-1)
        return squared.min(1), squared.argmin(1)

    def tree():
        return KDTree(other).query(points), KDTree(points).query(other)

    size = len(points)
    name = f"nearest neighbours both ways, {size:,}"
    ours = Compiled(functools.partial(both, nearest), points, other)
    times = in_turn(ours, tree)
    yield row(name, times[0], "SciPy KDTree", times[1], _target(size, 3), **ours.costs)
    if size <= 4096:
        dense = Compiled(functools.partial(both, plain), points, other)
        times = in_turn(ours, dense)
        yield row(name, times[0], "plain jax.numpy", times[1], **ours.costs)


def _farthest(points: np.ndarray, other: np.ndarray) -> Iterator[Row]:
    del other
    size, count = len(points), len(points) // 8

    def plain(points):
        def add(carry, _):
            distances, last = carry
            squared = ((points - points[last]) ** 2).sum(-1)
            distances = jnp.minimum(distances, squared)
            return (distances, distances.argmax()), last

        start = (jnp.full(size, jnp.inf), jnp.int32(0))
        return jax.lax.scan(add, start, None, length=count)[1]

    def peer():
        return fpsample.fps_sampling(points, count, start_idx=0)

    name = f"farthest points, {size:,} to {count:,}"
    ours = Compiled(lambda points: farthest_point_sample(points, count), points)
    naive = Compiled(plain, points)
    times = in_turn(ours, peer, naive)
    target = _target(size, 1.5)
    yield row(name, times[0], "fpsample", times[1], target, **ours.costs)
    yield row(name, times[0], "plain jax.numpy", times[2], **ours.costs)


def _chamfer(points: np.ndarray, other: np.ndarray) -> Iterator[Row]:
    size, name = len(points), f"Chamfer, value and gradient, {len(points):,}"
    ours = Compiled(jax.value_and_grad(chamfer), points, other)
    if size == TARGET_SIZE:
        memory = [ours.peak_mib or np.nan]
        yield row(f"{name}, memory", memory, "100 MB", [1e8 / 2**20], 1.0, unit="MiB")
    torch = _optional("torch")
    if torch is None or size > LARGEST_DENSE:
        return
    a = torch.from_numpy(points).requires_grad_()
    b = torch.from_numpy(other)

    def cdist():
        a.grad = None
        squared = torch.cdist(a, b) ** 2
        (squared.min(1)[0].mean() + squared.min(0)[0].mean()).backward()

    times = in_turn(ours, cdist)
    yield row(name, times[0], "PyTorch cdist", times[1], **ours.costs)


def _normals(points: np.ndarray, other: np.ndarray) -> Iterator[Row]:
    del other

    def plain(points):
        squared = ((points[:, None] - points[None]) ** 2).sum(-1)
        neighbors = points[jax.lax.top_k(-squared, 16)[1]]
        offsets = neighbors - neighbors.mean(1, keepdims=True)
        covariance = jnp.einsum("nki,nkj->nij", offsets, offsets)
        return jnp.linalg.eigh(covariance)[1][:, :, 0]

    size, name = len(points), f"PCA normals, k = 16, {len(points):,}"
    ours = Compiled(lambda points: pca_normals(points, 16), points)
    if size <= LARGEST_DENSE:
        dense = Compiled(plain, points)
        times = in_turn(ours, dense)
        target = _target(size, 0.2)
        yield row(name, times[0], "plain knn and eigh", times[1], target, **ours.costs)
    open3d = _optional("open3d")
    if open3d is None:
        return
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    search = open3d.geometry.KDTreeSearchParamKNN(16)
    times = in_turn(ours, lambda: cloud.estimate_normals(search))
    yield row(name, times[0], "Open3D", times[1], **ours.costs)


def _sinkhorn(size: int) -> Iterator[Row]:
    ott = _optional("ott")
    if ott is None:
        return
    geometry = importlib.import_module("ott.geometry.geometry")
    linear = importlib.import_module("ott.solvers.linear")
    cost = np.random.default_rng(size).uniform(size=(size, size)).astype(np.float32)
    iterations = 50

    def peer(cost):
        solved = linear.solve(
            geometry.Geometry(cost, epsilon=0.05),
            threshold=-1.0,
            min_iterations=iterations,
            max_iterations=iterations,
        )
        return solved.matrix

    ours = Compiled(lambda cost: sinkhorn(cost, 0.05, iterations)[0], cost)
    times = in_turn(ours, Compiled(peer, cost))
    name = f"Sinkhorn, {iterations} iterations, {size:,} x {size:,}"
    yield row(name, times[0], "OTT-JAX", times[1], **ours.costs)
