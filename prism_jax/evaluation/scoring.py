"""Every metric of every cloud of one example, with each search done once."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from prism_jax import metrics
from prism_jax.completion import keep_unmeasured
from prism_jax.data.ordering import farthest_point_order

EMD_POINTS = 1024
"""The exact earth mover's distance is taken between so many farthest points."""

METRICS = ("cd_l2", "cd_l1", "f_score", "emd", "hd")

MERGED = {"output": "merged", "unadapted": "merged_unadapted"}
"""Names of the predictions with the measured points kept."""


class Scene(NamedTuple):
    """One example and its predictions, all in the frame and unit of the scores.

    Attributes:
      complete: the ground truth.
      few: `EMD_POINTS` farthest points of it.
      measured: the partial as it was measured.
      partial: the partial as the completer got it.
      predictions: by name, ``output`` and perhaps ``unadapted``.
    """

    complete: Float[np.ndarray, "M 3"]
    few: Float[np.ndarray, "E 3"]
    measured: Float[np.ndarray, "N 3"]
    partial: Float[np.ndarray, "P 3"]
    predictions: dict[str, Float[np.ndarray, "_ 3"]]


class _Found(NamedTuple):
    """Nearest neighbours of a cloud in the complete one and the reverse, with the rows
    of the cloud that the latter are."""

    cloud: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    rows: np.ndarray


def score(
    scene: Scene, with_emd: bool = True, with_measured: bool = True
) -> dict[str, dict[str, float]]:
    """`METRICS` of each prediction and, `with_measured`, of ``control``, the partial
    itself, and of each prediction with the measured points kept (`MERGED`).

    As the functions of `prism_jax.metrics` give them, but for the last bits. Without
    `with_emd`, ``emd`` is left out. Pure NumPy and SciPy on one thread, mostly without
    Python's lock.
    """
    tree = KDTree(scene.complete)
    found, predictions = {}, scene.predictions
    if with_measured:
        found["control"] = _find(scene.measured, scene.complete, tree)
    for name, cloud in predictions.items():
        if name != "output" and np.array_equal(cloud, predictions["output"]):
            continue  # Adaptation was not accepted.
        found[name] = prediction = _find(cloud, scene.complete, tree)
        if with_measured:
            keep = keep_unmeasured(cloud, scene.measured, scene.partial)
            merged = _merged(found["control"], prediction, keep, scene.complete)
            found[MERGED[name]] = merged
    scores = {
        name: metrics.from_distances(one.forward, one.backward).named()
        for name, one in found.items()
    }
    for row in scores.values():
        row["hd"] = row.pop("hausdorff")
    if with_emd:
        few = {
            name: farthest_point_order(one.cloud, EMD_POINTS)
            for name, one in found.items()
        }
        # The partial is unlike the others, which are much like each other.
        alike = [name for name in few if name != "control"]
        for names in (few.keys() - alike, alike):
            values = metrics.emds([few[name] for name in names], scene.few)
            for name, value in zip(names, values, strict=True):
                scores[name]["emd"] = value
    for name in predictions.keys() - scores.keys():
        scores[name] = scores["output"]
        if with_measured:
            scores[MERGED[name]] = scores["merged"]
    return {
        name: {metric: row[metric] for metric in METRICS if metric in row}
        for name, row in scores.items()
    }


def _find(cloud: np.ndarray, complete: np.ndarray, tree: KDTree) -> _Found:
    backward, rows = KDTree(cloud).query(complete)
    return _Found(cloud, tree.query(cloud)[0], backward, np.asarray(rows))


def _merged(
    control: _Found, prediction: _Found, keep: np.ndarray, complete: np.ndarray
) -> _Found:
    """The measured points and then the kept ones, from what is known of both.

    Of the complete points only those are searched again whose nearest predicted point
    was not kept.
    """
    cloud = np.concatenate([control.cloud, prediction.cloud[keep]])
    forward = np.concatenate([control.forward, prediction.forward[keep]])
    nearest = prediction.backward.copy()
    lost = ~keep[prediction.rows]
    if not keep.any():
        nearest[:] = np.inf
    elif lost.any():
        nearest[lost] = KDTree(prediction.cloud[keep]).query(complete[lost])[0]
    backward = np.minimum(control.backward, nearest)
    return _Found(cloud, forward, backward, prediction.rows)
