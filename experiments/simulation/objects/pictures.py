"""Pictures of models and of their clouds to look at: upright, whole, recognisable?"""

import jax.numpy as jnp
import numpy as np

from experiments.simulation.contact_sheet import (
    GROUND_TRUTH,
    OBSERVED,
    TOWARD_VIEWER,
    Row,
    draw,
    draw_clouds,
)
from experiments.simulation.objects.build import ObjectsConfig, model_views
from experiments.simulation.objects.models import Model
from prism_jax.geometry.camera import Camera

DISTANCE = 5.0
"""Of the viewer from the middle of the clouds, which span [-1, 1]."""


def model_row(model: Model, seed: int, size: int) -> Row:
    """Two square pictures from one side: the mesh, and its first partial cloud in blue
    before the complete one in amber."""
    config = ObjectsConfig("test", num_views=1, seed=seed)
    (partial,), complete, *_ = model_views(config, model)
    toward = np.asarray(TOWARD_VIEWER) / np.linalg.norm(TOWARD_VIEWER)
    cloud = jnp.asarray(complete)
    camera = Camera.framing(cloud, DISTANCE * toward, 1.1, size, size)
    clouds = draw_clouds([(complete, GROUND_TRUTH), (partial, OBSERVED)], camera)
    return Row(model.title, (draw(model.load(), size), clouds))


def credit(model: Model) -> str:
    """Whom a model is by, as its licence asks for."""
    made = f"{model.title} by {model.creator} ({model.catalogue})"
    return f"{made}, {model.licence}, turned and scaled"
