"""Pure functions of arrays: cameras, rendering, neighbours, sampling, transport."""

from prism_jax.geometry.camera import VIEWS, Camera
from prism_jax.geometry.neighbors import knn, nearest, three_point_interpolate
from prism_jax.geometry.normals import pca_normals
from prism_jax.geometry.render import render_depth
from prism_jax.geometry.sampling import farthest_point_sample, resample
from prism_jax.geometry.transport import sinkhorn
from prism_jax.geometry.workspace import Workspace

__all__ = [
    "VIEWS",
    "Camera",
    "Workspace",
    "farthest_point_sample",
    "knn",
    "nearest",
    "pca_normals",
    "render_depth",
    "resample",
    "sinkhorn",
    "three_point_interpolate",
]
