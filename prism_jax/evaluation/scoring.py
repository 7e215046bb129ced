"""Every metric of every cloud of one example, with each search done once."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from prism_jax import metrics
from prism_jax.data.ordering import farthest_point_order
from prism_jax.metrics import Scores
from prism_jax.selection import keep_unmeasured

EMD_POINTS = 1024
"""The exact earth mover's distance is computed between this many farthest points."""

CLOUDS = (
    "partial",
    "network_unadapted",
    "network",
    "completed_unadapted",
    "completed",
)
"""Names of the clouds that are scored, in the order in which tables list them:

partial: the measured points.
network: all that the network predicts.
completed: what a user gets, the measured points and, where nothing was measured,
  predicted ones.
network_unadapted, completed_unadapted: the same without test-time adaptation. Only
  where the prediction was adapted and the one before is known too.
"""


class ExampleClouds(NamedTuple):
    """One example and what was predicted for it, in the frame and unit of the scores.

    Attributes:
      complete: the ground truth.
      complete_few: `EMD_POINTS` farthest points of it.
      partial: the measured points.
      network_input: those of them that the network read.
      network, network_unadapted: predicted points; the latter None if not adapted.
    """

    complete: Float[np.ndarray, "M 3"]
    complete_few: Float[np.ndarray, "E 3"]
    partial: Float[np.ndarray, "N 3"]
    network_input: Float[np.ndarray, "I 3"]
    network: Float[np.ndarray, "P 3"]
    network_unadapted: Float[np.ndarray, "P 3"] | None = None


class _Matched(NamedTuple):
    """A cloud, its points' distances to the nearest complete ones (`forward`), the
    reverse (`backward`), and which rows of the cloud the latter lead to."""

    cloud: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    rows: np.ndarray


def score(
    clouds: ExampleClouds, with_emd: bool = True, with_measured: bool = True
) -> dict[str, Scores]:
    """The scores of all `CLOUDS` that can be made of an example.

    Values are those of the functions of `prism_jax.metrics`, except for the last bits.
    Without `with_measured` only ``network`` and ``network_unadapted`` are scored.
    Runs on one thread, mostly without holding Python's lock.
    """
    tree = KDTree(clouds.complete)
    partial = _match(clouds.partial, clouds.complete, tree) if with_measured else None
    matched = {} if partial is None else {"partial": partial}
    equal = clouds.network_unadapted is not None and np.array_equal(
        clouds.network_unadapted, clouds.network
    )
    for suffix, cloud in (
        ("", clouds.network),
        ("_unadapted", None if equal else clouds.network_unadapted),
    ):
        if cloud is None:
            continue
        network = _match(cloud, clouds.complete, tree)
        matched[f"network{suffix}"] = network
        if partial is not None:
            keep = keep_unmeasured(cloud, clouds.partial, clouds.network_input)
            completed = _completed(partial, network, keep, clouds.complete)
            matched[f"completed{suffix}"] = completed
    scores = {
        name: metrics.from_distances(one.forward, one.backward)
        for name, one in matched.items()
    }
    if with_emd:
        for name, value in _emds(matched, clouds.complete_few).items():
            scores[name] = scores[name]._replace(emd=value)
    if equal:
        scores |= {f"{k}_unadapted": v for k, v in scores.items() if k != "partial"}
    return {name: scores[name] for name in CLOUDS if name in scores}


def _match(cloud: np.ndarray, complete: np.ndarray, tree: KDTree) -> _Matched:
    backward, rows = KDTree(cloud).query(complete)
    return _Matched(cloud, tree.query(cloud)[0], backward, np.asarray(rows))


def _completed(
    partial: _Matched, network: _Matched, keep: np.ndarray, complete: np.ndarray
) -> _Matched:
    """The measured points followed by the predicted ones in `keep`.

    The search is repeated only for complete points whose nearest predicted point was
    dropped.
    """
    cloud = np.concatenate([partial.cloud, network.cloud[keep]])
    forward = np.concatenate([partial.forward, network.forward[keep]])
    nearest = network.backward.copy()
    lost = ~keep[network.rows]
    if not keep.any():
        nearest[:] = np.inf
    elif lost.any():
        nearest[lost] = KDTree(network.cloud[keep]).query(complete[lost])[0]
    backward = np.minimum(partial.backward, nearest)
    return _Matched(cloud, forward, backward, network.rows)


def _emds(
    matched: dict[str, _Matched], complete_few: Float[np.ndarray, "E 3"]
) -> dict[str, float]:
    """The exact earth mover's distance of each cloud's farthest points."""
    few = {k: farthest_point_order(m.cloud, EMD_POINTS) for k, m in matched.items()}
    values = {}
    # `emds` is fast for clouds that are alike, and the partial is unlike the others.
    for names in (["partial"] * ("partial" in few), [k for k in few if k != "partial"]):
        found = metrics.emds([few[name] for name in names], complete_few)
        values |= dict(zip(names, found, strict=True))
    return values
