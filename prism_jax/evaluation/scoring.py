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
completed: what a user gets, the measured points and what is added to them
  (`prism_jax.completion.filtering.added_points`).
network_unadapted, completed_unadapted: the same without test-time adaptation. Only
  where the prediction was adapted and the one before is known too.
"""


def score(
    clouds: Mapping[str, Float[np.ndarray, "_ 3"]],
    complete: Float[np.ndarray, "M 3"],
    complete_few: Float[np.ndarray, "E 3"] | None = None,
) -> dict[str, Scores]:
    """The scores of those of `CLOUDS` that there are of an example, in the frame and
    unit of the scores.

    `complete` is the ground truth, and `complete_few` `EMD_POINTS` farthest points of
    it; without them there is no earth mover's distance. One array under two names is
    scored once. Runs on one thread, mostly without holding Python's lock.
    """
    tree = KDTree(complete)
    apart = {id(cloud): name for name, cloud in reversed(clouds.items())}  # pyright: ignore
    first = {name: apart[id(cloud)] for name, cloud in clouds.items()}
    distinct = {name: clouds[name] for name in dict.fromkeys(first.values())}
    scores = {
        name: metrics.from_distances(
            tree.query(cloud)[0], KDTree(cloud).query(complete)[0]
        )
        for name, cloud in distinct.items()
    }
    if complete_few is not None:
        for name, value in _emds(distinct, complete_few).items():
            scores[name] = scores[name]._replace(emd=value)
    return {name: scores[first[name]] for name in CLOUDS if name in clouds}


def _emds(
    clouds: dict[str, np.ndarray], complete_few: Float[np.ndarray, "E 3"]
) -> dict[str, float]:
    """The exact earth mover's distance of each cloud's farthest points."""
    few = {k: farthest_point_order(c, EMD_POINTS) for k, c in clouds.items()}
    values = {}
    # `emds` is fast for clouds that are alike, and the partial is unlike the others.
    for names in (["partial"] * ("partial" in few), [k for k in few if k != "partial"]):
        found = metrics.emds([few[name] for name in names], complete_few)
        values |= dict(zip(names, found, strict=True))
    return values
