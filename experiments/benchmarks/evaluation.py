"""Frames evaluated a second: many at once against one after the other."""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from experiments.assets import CELLS
from experiments.benchmarks.measure import Row, in_turn, row
from experiments.protocol import Protocol, into_scored, observed, side_by_side
from experiments.scored_run import CompleteFn, Predictions, evaluate, scored_clouds
from experiments.scoring import prism_completer
from experiments.weights import located
from prism_jax.completion.weights import load_pretrained
from prism_jax.data.ordering import farthest_point_order, first_points
from prism_jax.data.pipeline import with_partial
from prism_jax.data.recordings import RecordedCells
from prism_jax.data.source import Source
from prism_jax.evaluation import metrics
from prism_jax.evaluation.scoring import EMD_POINTS

MOST = 1 / 5


def suite(weights: str = "small") -> Iterator[Row]:
    """The recorded frames, completed at once and scored on all cores.

    Against each completed alone and each of its clouds scored by the functions of
    `prism_jax.evaluation.metrics`, and against batches of one in one thread.
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


def score_separately(
    completer: CompleteFn, source: Source, protocol: Protocol
) -> list[dict[str, dict[str, float]]]:
    """What `evaluate` scores, of one frame and cloud after the other."""
    rows = []
    for clouds, complete, few in completed_clouds(completer, source, protocol):
        scores = {}
        for name, cloud in clouds.items():
            fewer = farthest_point_order(cloud, EMD_POINTS)
            emd = metrics.emd(fewer, few)
            scores[name] = metrics.score(cloud, complete)._replace(emd=emd).named()
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
