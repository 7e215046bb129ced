"""A completer run over a data set and scored, batch by batch."""

import collections
import concurrent.futures
import itertools
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.data.ordering import first_points
from prism_jax.data.pipeline import with_partial
from prism_jax.data.source import Example, Source
from prism_jax.evaluation.protocol import (
    UNITS,
    Protocol,
    into_scored,
    observed,
    side_by_side,
)
from prism_jax.evaluation.scoring import EMD_POINTS, Scene, score
from prism_jax.evaluation.summary import Scores, summarise
from prism_jax.geometry.workspace import Workspace
from prism_jax.models.variables import Variables, apply
from prism_jax.observation.observation import observe

CompleteFn = Callable[
    [Float[np.ndarray, "B N 3"], Float[np.ndarray, "B 3"]],
    Mapping[str, Array | np.ndarray],
]
"""What is scored: partial clouds and the sensors' places, in the unit workspace, to
clouds there. ``output`` (B, M, 3) must be in the result; ``unadapted`` (B, M, 3), the
output without adaptation, and ``accepted`` (B,), whether it was adapted, may be.
Jitted functions and plain ones will do."""


def prism_completer(config: PrismConfig, variables: Variables) -> CompleteFn:
    """PRISM with its test-time adaptation, jitted; compiled for each size of a batch.

    With ``num_steps=0`` there is the output alone.
    """
    adapt = make_adapt(config)

    def one(variables: Variables, partial: Array, eye: Array):
        camera = observe(partial, eye, Workspace.unit()).camera
        done = adapt(variables, partial, camera)
        if config.adapt.num_steps == 0:
            return {"output": done.points}
        return {
            "output": done.points,
            "unadapted": done.before,
            "accepted": done.accepted,
        }

    batched = jax.jit(jax.vmap(one, (None, 0, 0)))
    return lambda partials, eyes: batched(variables, partials, eyes)


def network_completer(module: nn.Module, variables: Variables) -> CompleteFn:
    """A network from partials to its stages, the last of which is its output; jitted,
    and compiled for each size of a batch."""
    batched = jax.jit(lambda variables, partials: apply(module, variables, partials))
    return lambda partials, eyes: {"output": batched(variables, partials)[-1]}


def evaluate(
    complete_fn: CompleteFn,
    source: Source,
    protocol: Protocol,
    limit: int | None = None,
    batch_size: int = 20,
    num_workers: int | None = None,
) -> dict[str, Any]:
    """Scores of the output, and of what it is to be compared with, as JSON.

    ``mean``, ``intervals`` and ``per_category`` are of the output; ``unadapted``,
    ``control`` (the partial itself), ``merged`` and ``merged_unadapted`` (the measured
    points kept) have the same three; the last three only with
    `Protocol.with_measured`. Distances are in ``unit``, squared where the metric is,
    and nothing is scaled. ``accepted`` is the share of frames whose adaptation was.
    ``per_example`` holds CD-L2 and F-score of every cloud, for `paired_difference`.

    Of the source's examples the first ``limit`` count; one without a complete cloud
    raises InputError. While one batch is completed, the one before is scored by
    `num_workers` threads, one a core by default.
    """
    count = len(source) if limit is None else min(limit, len(source))
    size = min(batch_size, count)
    rows: list[Scores] = []
    waiting: collections.deque = collections.deque()
    with (
        tqdm(total=count, desc="evaluate", unit="shape", mininterval=2.0) as bar,
        concurrent.futures.ThreadPoolExecutor(num_workers or os.cpu_count()) as pool,
    ):
        batches = _complete(complete_fn, source, protocol, count, size)
        for batch in itertools.chain(batches, [None]):
            if batch is not None:
                waiting.append([pool.submit(_score, item, protocol) for item in batch])
            while waiting and (batch is None or len(waiting) > 1):
                for future in waiting.popleft():
                    rows.append(future.result())
                    bar.update()
    return {
        "unit": UNITS[protocol.unit],
        "num_partial": protocol.num_partial,
        **summarise(rows, source.categories, source.objects[:count]),
    }


class _Item(NamedTuple):
    example: Example
    partial: np.ndarray
    completed: dict[str, np.ndarray]


def _complete(
    complete_fn: CompleteFn,
    source: Source,
    protocol: Protocol,
    count: int,
    batch_size: int,
) -> Iterator[list[_Item]]:
    """Batches of one size; the last is filled up with the first examples."""
    for start in range(0, count, batch_size):
        rows = np.arange(start, start + batch_size) % count
        examples = [with_partial(source[int(row)]) for row in rows]
        seen = [observed(example, protocol) for example in examples]
        partials, eyes = side_by_side(seen)
        completed = jax.device_get(complete_fn(partials, eyes))
        yield [
            _Item(examples[i], partials[i], {k: v[i] for k, v in completed.items()})
            for i in range(min(batch_size, count - start))
        ]


def _score(item: _Item, protocol: Protocol) -> Scores:
    """One example's scores, in their frame."""
    example, accepted = item.example, item.completed.get("accepted")
    assert example.partial is not None and example.complete is not None
    scaled, from_workspace = into_scored(example, protocol)
    few = first_points(example.complete, EMD_POINTS, example.ordered)
    scene = Scene(
        complete=scaled(example.complete),
        few=scaled(few),
        measured=scaled(example.partial),
        partial=from_workspace(item.partial),
        predictions={
            name: from_workspace(item.completed[name])
            for name in ("output", "unadapted")
            if name in item.completed
        },
    )
    return Scores(
        example.name,
        example.category,
        None if accepted is None else bool(accepted),
        score(scene, protocol.with_emd, protocol.with_measured),
    )
