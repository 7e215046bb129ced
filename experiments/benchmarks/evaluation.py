"""Frames evaluated a second: many at once against one after the other."""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from experiments.assets import CELLS
from experiments.benchmarks.measure import Row, in_turn, row
from experiments.weights import located
from prism_jax.completion.weights import load_pretrained
from prism_jax.data.ordering import farthest_point_order, first_points
from prism_jax.data.pipeline import with_partial
from prism_jax.data.recordings import RecordedCells
from prism_jax.data.source import Source
from prism_jax.evaluation import metrics
from prism_jax.evaluation.protocol import Protocol, into_scored, observed, side_by_side
from prism_jax.evaluation.run import (
    CompleteFn,
    Predictions,
    evaluate,
    prism_completer,
    scored_clouds,
)
from prism_jax.evaluation.scoring import EMD_POINTS

MOST = 1 / 5


def suite(weights: str = "small") -> Iterator[Row]:
    """The recorded frames, completed at once and scored on all cores.

    Against each completed alone and each of its clouds scored by the functions of
    `prism_jax.evaluation.metrics`, and against batches of one in one thread. Then their
    exact EMD against SciPy's assignment without a start.
    """
    config, variables = load_pretrained(located(weights))
    source = RecordedCells(CELLS)
    completer = prism_completer(config, variables)
    protocol = Protocol(config.model.backbone.num_points, config.model.margin)
    run = functools.partial(evaluate, completer, source, protocol)
    ours, separate, batches_of_one = in_turn(
        lambda: run(batch_size=len(source)),
        lambda: score_separately(completer, source, protocol),
        lambda: run(batch_size=1, num_workers=1),
    )
    name = f"{weights}, {len(source)} frames evaluated"
    yield row(name, ours, "frame by frame, cloud by cloud", separate, MOST)
    yield row(name, ours, "batches of one", batches_of_one)
    frames = [
        ([farthest_point_order(cloud, EMD_POINTS) for cloud in clouds.values()], few)
        for clouds, _, few in completed_clouds(completer, source, protocol)
    ]
    started, plain = in_turn(
        lambda: [metrics.emds(clouds, few) for clouds, few in frames],
        lambda: [[plain_emd(cloud, few) for cloud in c] for c, few in frames],
    )
    yield row(f"exact EMD, {len(frames)} frames", started, "SciPy alone", plain, 1.0)


def score_separately(
    completer: CompleteFn, source: Source, protocol: Protocol
) -> list[dict[str, dict[str, float]]]:
    """What `evaluate` scores, of one frame and cloud after the other."""
    rows = []
    for clouds, complete, few in completed_clouds(completer, source, protocol):
        scores = {}
        for name, cloud in clouds.items():
            fewer = farthest_point_order(cloud, EMD_POINTS)
            scores[name] = {
                "cd_l2": metrics.cd_l2(cloud, complete),
                "cd_l1": metrics.cd_l1(cloud, complete),
                "f_score": metrics.f_score(cloud, complete),
                "emd": metrics.emd(fewer, few),
                "hausdorff": metrics.hausdorff(cloud, complete),
            }
        rows.append(scores)
    return rows


def completed_clouds(
    completer: CompleteFn, source: Source, protocol: Protocol
) -> Iterator[tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]]:
    """Each frame's clouds by name, its complete cloud, and `EMD_POINTS` of that."""
    for example in (with_partial(source[index]) for index in range(len(source))):
        partials, eyes = side_by_side([observed(example, protocol)])
        done = jax.device_get(completer(partials, eyes))
        assert example.complete is not None and example.partial is not None
        from_own, _ = into_scored(example, protocol)
        complete = from_own(example.complete)
        few = first_points(complete, EMD_POINTS, example.ordered)
        rows: Any = (None if x is None else x[0] for x in done)
        alone = Predictions(*rows)
        yield scored_clouds(example, partials[0], alone, protocol), complete, few


def plain_emd(cloud: np.ndarray, target: np.ndarray) -> float:
    """`metrics.emd` without a start for SciPy's assignment."""
    cost = cdist(cloud, target)
    return float(cost[linear_sum_assignment(cost)].mean())
