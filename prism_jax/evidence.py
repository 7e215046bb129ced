"""What speaks for or against a completion without the truth being known."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from prism_jax.geometry.visibility import seen_by
from prism_jax.models.backbone import (
    decode,
    encode_points,
    partial_indices,
    with_depth,
)
from prism_jax.models.config import ModelConfig
from prism_jax.models.poses import POSES, posed
from prism_jax.models.prism import refine, view_from
from prism_jax.models.variables import Variables
from prism_jax.observation.observation import Observation
from prism_jax.observation.visibility import looked_through
from prism_jax.selection import ABOUT, Selection, usual_spacing

SAMPLE = 1024
"""Measured points that are asked, evenly spaced rows of a larger cloud."""

NEIGHBORS = 12
"""Of a measured point, that a plane is laid through."""


class SecondLook(NamedTuple):
    """What the network as released makes of a partial, and of it in other poses.

    Attributes:
      features: the encoder's global feature.
      prediction: the completion.
      mirrored, turned: those of the mirror image in x and of a quarter turn about z,
        brought back.
    """

    features: Float[Array | np.ndarray, " G"]
    prediction: Float[Array | np.ndarray, "P 3"]
    mirrored: Float[Array | np.ndarray, "P 3"]
    turned: Float[Array | np.ndarray, "P 3"]


LookFn = Callable[[Variables, Array, Array], SecondLook]

_POSES = POSES[:3]


def make_second_look(model: ModelConfig) -> LookFn:
    """The function of variables, a partial of ``num_points`` points in the unit
    workspace, and the sensor's place there. Pure; ``jit`` it."""

    def look(
        variables: Variables, partial: Float[Array, "N 3"], eye: Float[Array, "3"]
    ) -> SecondLook:
        # One pass for all poses.
        clouds = posed("nj,pij->pni", partial, _POSES)
        eyes, known = posed("j,pij->pi", eye, _POSES), None
        if model.backbone.reads_visibility:
            see = functools.partial(seen_by, background=model.background)
            known = jax.vmap(see)(clouds, eyes)
        indices = partial_indices(clouds, model.backbone)
        encoded = encode_points(variables, model.backbone, clouds, indices)
        if model.backbone.reads_depth:
            view = jax.vmap(lambda *one: view_from(*one, model))(clouds, eyes)
            encoded = with_depth(encoded, variables, model, view)
        decoded = decode(variables, model.backbone, clouds, encoded, None, known)
        points = refine(variables, decoded, model)
        back = posed("pni,pij->pnj", points, _POSES)
        return SecondLook(encoded.global_feature[0], *back)

    return look


def evidence_of(
    seen: Observation,
    read: Observation,
    prediction: Float[np.ndarray, "P 3"],
    selection: Selection,
    look: SecondLook,
    novelty: float,
) -> dict[str, float]:
    """The numbers that `prism_jax.trust.Calibration` turns into a verdict, by name.

    `seen` and `read` are what was observed and what the network read of it,
    `prediction` its output, adapted or not, and `selection` what became of that.
    `novelty` is how far `look`'s features are from those of the training. Lengths are
    in half sides of the workspace. None is asked of an empty prediction.
    """
    measured = np.asarray(seen.partial, np.float64)[np.asarray(seen.inside)]
    distinct = np.unique(measured, axis=0)
    partial = np.asarray(read.partial, np.float64)
    some = asked(distinct)
    eye = np.asarray(seen.eye, np.float64)
    spacing = usual_spacing(partial)
    away = KDTree(distinct).query(prediction)[0]
    through = looked_through(prediction, partial, eye, ABOUT * spacing)
    return {
        "num_points": float(len(distinct)),
        "spacing": float(min(spacing, 1.0)),
        "roughness": roughness(distinct, some),
        "strays": float((selection.stray | selection.outside).mean()),
        "in_front": float(selection.in_front.mean()),
        "looked_through": float(through.mean()),
        "unexplained": float(KDTree(prediction).query(some)[0].mean()),
        "reach": float(away.mean()),
        "disagreement_mirrored": _apart(look.prediction, look.mirrored),
        "disagreement_turned": _apart(look.prediction, look.turned),
        "novelty": novelty,
    }


def asked(cloud: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """`SAMPLE` of a larger cloud, or fewer; evenly spaced rows."""
    return cloud[:: -(-len(cloud) // SAMPLE)]


def roughness(cloud: Float[np.ndarray, "N 3"], some: Float[np.ndarray, "M 3"]) -> float:
    """Usual distance of some of a cloud's points from the planes through their
    neighbours. Of too few neighbours it is 0."""
    if len(cloud) <= NEIGHBORS:
        return 0.0
    near = cloud[np.asarray(KDTree(cloud).query(some, k=NEIGHBORS)[1])]
    offsets = near - near.mean(axis=1, keepdims=True)
    squares = np.einsum("nki,nkj->nij", offsets, offsets) / NEIGHBORS
    thickness = np.linalg.eigvalsh(squares)[:, 0]
    return float(np.sqrt(np.median(np.maximum(thickness, 0.0))))


def _apart(first: Array | np.ndarray, second: Array | np.ndarray) -> float:
    """CD-L1 of two completions."""
    one, other = (np.asarray(cloud, np.float64) for cloud in (first, second))
    there = KDTree(other).query(one)[0].mean()
    return float(0.5 * (there + KDTree(one).query(other)[0].mean()))
