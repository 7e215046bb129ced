"""PRISM in JAX: completion of sparse scans with test-time adaptation."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prism_jax.adaptation.test_time import make_adapt
    from prism_jax.completion.completer import Completer
    from prism_jax.completion.weights import load_pretrained
    from prism_jax.evaluation.metrics import f_score
    from prism_jax.geometry.camera import Camera
    from prism_jax.geometry.neighbors import knn, nearest
    from prism_jax.geometry.normals import pca_normals
    from prism_jax.geometry.render import render_depth
    from prism_jax.geometry.sampling import farthest_point_sample
    from prism_jax.geometry.transport import sinkhorn
    from prism_jax.geometry.workspace import Workspace
    from prism_jax.losses.chamfer import chamfer
    from prism_jax.preprocessing.observation import observe

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Completer",
    "Workspace",
    "chamfer",
    "f_score",
    "farthest_point_sample",
    "knn",
    "load_pretrained",
    "make_adapt",
    "nearest",
    "observe",
    "pca_normals",
    "render_depth",
    "sinkhorn",
]

# Each is imported at its first use: a command can be interrupted before that, and one
# function does not load all others.
_MODULES = {
    "Camera": "geometry.camera",
    "Completer": "completion.completer",
    "Workspace": "geometry.workspace",
    "chamfer": "losses.chamfer",
    "f_score": "evaluation.metrics",
    "farthest_point_sample": "geometry.sampling",
    "knn": "geometry.neighbors",
    "load_pretrained": "completion.weights",
    "make_adapt": "adaptation.test_time",
    "nearest": "geometry.neighbors",
    "observe": "preprocessing.observation",
    "pca_normals": "geometry.normals",
    "render_depth": "geometry.render",
    "sinkhorn": "geometry.transport",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    return getattr(module, name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
