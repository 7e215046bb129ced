"""Every metric of every cloud of one example, with each search done once."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from prism_jax.data.ordering import farthest_point_order
from prism_jax.evaluation import metrics
from prism_jax.evaluation.metrics import Scores

EMD_POINTS = 1024
"""The exact earth mover's distance is computed between this many farthest points."""

CLOUDS = ("partial", "network_unadapted", "network", "completed_unadapted", "completed")
"""Names of the clouds that are scored, in the order in which tables list them:

partial: the measured points.
network: all that the network predicts.
completed: what a user gets, the measured points and then what is added to them
  (`prism_jax.completion.filtering.added_points`).
network_unadapted, completed_unadapted: the same without test-time adaptation. Only
  where the prediction was adapted and the one before is known too.
"""


def score(
    clouds: Mapping[str, Float[np.ndarray, "_ 3"]],
    measured: Float[np.ndarray, "N 3"],
    complete: Float[np.ndarray, "M 3"],
    complete_few: Float[np.ndarray, "E 3"] | None = None,
) -> dict[str, Scores]:
    """The scores of those of `CLOUDS` that there are of an example, in the frame and
    unit of the scores.

    `measured` are the points of the partial, to which all of a ``network`` cloud counts
    as added. `complete` is the ground truth, and `complete_few` `EMD_POINTS` farthest
    points of it; without them there is no earth mover's distance. One array under two
    names is scored once. Runs on one thread, mostly without holding Python's lock.
    """
    tree, scores = KDTree(complete), {}
    apart = KDTree(measured).query(complete)[0]
    side = float(np.ptp(complete, axis=0).max())
    for name, cloud in clouds.items():
        if id(cloud) in scores:
            continue
        forward = tree.query(cloud)[0]
        backward = apart if name == "partial" else KDTree(cloud).query(complete)[0]
        found = metrics.from_distances(forward, backward)
        if name != "partial":
            added = forward[len(measured) :] if "completed" in name else forward
            unseen = backward[apart > metrics.UNSEEN * side]
            found = found._replace(**metrics.unseen_scores(added, unseen, side))
        if complete_few is not None:
            few = farthest_point_order(cloud, EMD_POINTS)
            found = found._replace(emd=metrics.emd(few, complete_few))
        scores[id(cloud)] = found
    return {name: scores[id(clouds[name])] for name in CLOUDS if name in clouds}
