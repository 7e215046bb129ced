"""A completer run over a data set and scored, batch by batch."""

import concurrent.futures
import itertools
import operator
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float
from tqdm import tqdm

from experiments.protocol import (
    UNITS,
    Protocol,
    into_scored,
    observed,
    side_by_side,
    workspace_for,
)
from experiments.summary import ExampleScores, summarise
from prism_jax.completion.filtering import added_points
from prism_jax.data.ordering import first_points
from prism_jax.data.pipeline import framed_map, with_partial
from prism_jax.data.source import Example, Source
from prism_jax.evaluation.scoring import EMD_POINTS, score
from prism_jax.geometry.visibility import Visibility
from prism_jax.preprocessing.observation import observe


class Predictions(NamedTuple):
    """What a completer returns for a batch, in the unit workspace."""

    network: Float[Array | np.ndarray, "B P 3"]  # the points that are scored
    # The same without test-time adaptation, and whether it was accepted for each; None
    # if the completer does not adapt.
    network_unadapted: Float[Array | np.ndarray, "B P 3"] | None = None
    accepted: Bool[Array | np.ndarray, " B"] | None = None


CompleteFn = Callable[..., Predictions]
"""What is scored: a function of partial clouds (B, N, 3) and the sensors' positions
(B, 3), both in the unit workspace, and, if the protocol says so, of their visibility
maps (None where the source has none). It may be jitted."""


def evaluate(
    complete_fn: CompleteFn,
    source: Source,
    protocol: Protocol,
    limit: int | None = None,
    batch_size: int = 20,
    num_workers: int | None = None,
) -> dict[str, Any]:
    """Scores of all `CLOUDS` over a data set, as JSON.

    `clouds` holds for each cloud the `mean`, its `intervals` and the means
    `per_category` of every metric, and how many examples it is `of` where some lack
    it (`metrics.unseen_scores`). Distances are in `unit`, squared where the
    metric is. If the completer adapts, `accepted` is the share of examples whose
    adaptation was accepted, and `adaptation` says what it changes. `per_example` holds
    what `paired_difference` needs.

    Only the first `limit` examples count; one without a complete cloud raises
    InputError. While one batch is completed, the one before is scored by `num_workers`
    threads.
    """
    count = len(source) if limit is None else min(limit, len(source))
    size = min(batch_size, count)
    rows: list[ExampleScores] = []
    waiting: list[concurrent.futures.Future[ExampleScores]] = []
    with (
        tqdm(total=count, desc="evaluate", unit="shape", mininterval=2.0) as bar,
        concurrent.futures.ThreadPoolExecutor(num_workers or os.cpu_count()) as pool,
    ):
        batches = _complete(complete_fn, source, protocol, count, size)
        for batch in itertools.chain(batches, [[]]):
            started = [pool.submit(_score, protocol, *item) for item in batch]
            for future in waiting:
                rows.append(future.result())
                bar.update()
            waiting = started
    return {
        "unit": UNITS[protocol.unit],
        "num_partial": protocol.num_partial,
        **summarise(rows, source.categories, source.objects[:count]),
    }


def _complete(
    complete_fn: CompleteFn, source: Source, protocol: Protocol, count: int, size: int
) -> Iterator[list[tuple[Example, np.ndarray, Predictions]]]:
    """Examples, what the network read of each, and predictions without a leading axis.
    Batches have one size; the last is filled up with the first examples."""
    for start in range(0, count, size):
        rows = np.arange(start, start + size) % count
        examples = [with_partial(source[int(row)]) for row in rows]
        seen = [observed(example, protocol) for example in examples]
        partials, eyes = side_by_side(seen)
        maps: list[Visibility | None] = []
        if protocol.uses_visibility:
            spaces = [workspace_for(example, protocol) for example in examples]
            each = map(framed_map, (e.visibility for e in examples), spaces)
            maps = [jax.tree.map(lambda *rows: np.stack(rows), *each)]
        predictions = jax.device_get(complete_fn(partials, eyes, *maps))
        each = [jax.tree.map(operator.itemgetter(i), predictions) for i in range(size)]
        yield [*zip(examples, partials, each, strict=True)][: count - start]


def scored_clouds(
    example: Example,
    partial: Float[np.ndarray, "N 3"],
    predictions: Predictions,
    protocol: Protocol,
) -> dict[str, Float[np.ndarray, "_ 3"]]:
    """Those of `CLOUDS` that there are of an example, in the frame of the scores.
    `partial` is what the completer read of it, and `predictions` are of it alone, both
    in the workspace."""
    assert example.partial is not None
    from_own, from_workspace = into_scored(example, protocol)
    workspace = workspace_for(example, protocol)
    seen = observe(example.partial.astype(np.float64), example.eye, workspace)
    measured, eye = np.asarray(seen.partial), np.asarray(seen.eye)
    visibility = None
    if protocol.uses_visibility:
        visibility = framed_map(example.visibility, workspace)
    clouds: dict[str, np.ndarray] = {}
    if protocol.with_measured:
        clouds["partial"] = from_own(example.partial)
    outputs = {"": predictions.network, "_unadapted": predictions.network_unadapted}
    for suffix, output in outputs.items():
        if output is None:
            continue
        if suffix and np.array_equal(output, predictions.network):
            clouds |= {f"{k}{suffix}": v for k, v in clouds.items() if k != "partial"}
            continue
        network = np.asarray(output, np.float64)
        clouds[f"network{suffix}"] = from_workspace(network)
        if protocol.with_measured:
            new, *_ = added_points(
                network,
                measured,
                partial,
                eye if seen.sensor_known else None,
                background=protocol.background,
                visibility=visibility,
            )
            cloud = np.concatenate([clouds["partial"], from_workspace(new)])
            clouds[f"completed{suffix}"] = cloud
    return clouds


def _score(
    protocol: Protocol, example: Example, partial: np.ndarray, predictions: Predictions
) -> ExampleScores:
    """The scores of one example, in their frame."""
    assert example.complete is not None and example.partial is not None
    from_own, _ = into_scored(example, protocol)
    few = None
    if protocol.with_emd:
        few = from_own(first_points(example.complete, EMD_POINTS, example.ordered))
    clouds = scored_clouds(example, partial, predictions, protocol)
    accepted = predictions.accepted
    return ExampleScores(
        example.name,
        example.category,
        None if accepted is None else bool(accepted),
        score(clouds, from_own(example.partial), from_own(example.complete), few),
    )
