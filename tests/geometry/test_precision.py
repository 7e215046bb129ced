"""Products of coordinates and of costs keep every bit where a network's may not: GPUs
round the factors of a float32 product to TF32 unless the program asks for more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax import Camera, Workspace, chamfer, pca_normals, render_depth
from prism_jax.geometry.neighbors import knn, three_point_interpolate
from prism_jax.losses.alignment import alignment_loss

POINTS = jnp.asarray(np.random.default_rng(0).normal(size=(32, 3)), jnp.float32)
EYE = jnp.array([4.0, 0.0, 0.0])


def camera(points):
    return Camera.framing(points, EYE, height=8, width=8)


WITH_PRODUCTS = {
    "framing": camera,
    "resized": lambda points: camera(points).resized(4, 4),
    "position": lambda points: camera(points).position,
    "project": lambda points: camera(points).project(points),
    "camera_to_unit": lambda points: (
        Workspace(points[0], points[1, 0] ** 2)
        .camera_to_unit(camera(points))
        .translation
    ),
    "render_depth": lambda points: render_depth(points, camera(points))[0],
    "three_point_interpolate": lambda points: three_point_interpolate(
        points, points[::2], points[::2], knn(points, points[::2], 3)
    ),
    "alignment_loss": lambda points: alignment_loss(points, 2 * points),
}


def products(function) -> list[str]:
    """Of a function's value and gradient, as they are given to the compiler."""

    def total(points):
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(function(points)))

    text = jax.jit(jax.value_and_grad(total)).lower(POINTS).as_text()
    return [line for line in text.splitlines() if "dot_general" in line]


@pytest.mark.parametrize("name", WITH_PRODUCTS)
def test_no_factor_is_rounded(name):
    found = products(WITH_PRODUCTS[name])
    assert found
    for line in found:
        assert "precision = [HIGHEST, HIGHEST]" in line, line


def test_distances_are_not_products_and_a_careless_product_is_found():
    assert not products(lambda points: chamfer(points, 2 * points))
    assert not products(lambda points: pca_normals(points, 8))
    (line, *_) = products(lambda points: points @ points.T)
    assert "HIGHEST" not in line
