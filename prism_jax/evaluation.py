"""Scores of a completer on a data set.

Every example is framed by its partial alone, as a deployment would, and scored in the
units of the examples: of the procedural shapes, where the longest side of the complete
cloud is 2.
"""

import concurrent.futures
import multiprocessing
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from prism_jax import metrics
from prism_jax.adaptation.config import AdaptConfig
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.completion import keep_unmeasured
from prism_jax.data.partials import farthest_point_order
from prism_jax.data.pipeline import (
    Batch,
    Framing,
    frame_example,
    stack,
    with_partial,
    workspace_of,
)
from prism_jax.data.source import Example, Source
from prism_jax.geometry.camera import Camera
from prism_jax.models.variables import Variables

EMD_POINTS = 1024
"""The exact earth mover's distance is taken between so many farthest points."""

METRICS = ("cd_l2", "cd_l1", "f_score", "emd", "hd")


class Scored(NamedTuple):
    """Clouds of one example, in its own scale, and what they are scored against: the
    complete cloud, and `EMD_POINTS` of it."""

    clouds: dict[str, Float[np.ndarray, "_ 3"]]
    complete: Float[np.ndarray, "M 3"]
    few: Float[np.ndarray, "E 3"]
    accepted: bool
    category: str


def evaluate(
    config: AdaptConfig,
    variables: Variables,
    source: Source,
    limit: int | None = None,
    batch_size: int = 20,
    num_workers: int = 2,
) -> dict[str, Any]:
    """Scores of the partial, the network's output and the merged cloud.

    ``output`` and ``merged`` come with ``_before`` for the network as it was. Each has
    the mean of every metric, its bootstrap 95 % interval over the examples, and the
    means by category; ``accepted`` is the share of frames whose adaptation was. Of the
    source's examples the first ``limit`` count; all must have a complete cloud.
    """
    count = len(source) if limit is None else min(limit, len(source))
    names: list[str] = []
    values, scored = [], []
    context = multiprocessing.get_context("spawn")
    with (
        tqdm(total=count, desc="evaluate", unit="shape", mininterval=2.0) as bar,
        concurrent.futures.ProcessPoolExecutor(num_workers, context) as pool,
    ):
        for batch in _complete(config, variables, source, count, batch_size):
            names = list(batch[0].clouds)
            scored += [(one.accepted, one.category) for one in batch]
            for row in pool.map(_score, batch):
                values.append(row)
                bar.update()
    table = np.array(values)
    accepted, categories = zip(*scored, strict=True)
    return {
        "num_examples": count,
        "accepted": float(np.mean(accepted)),
        **{
            name: _summary(table[:, i], np.array(categories), source.categories)
            for i, name in enumerate(names)
        },
    }


def _complete(
    config: AdaptConfig,
    variables: Variables,
    source: Source,
    count: int,
    batch_size: int,
) -> Iterator[list[Scored]]:
    adapt = make_adapt(config)

    @jax.jit
    def complete(variables, partials, eyes):
        def one(partial, eye):
            done = adapt(variables, partial, Camera.framing(partial, eye))
            return done.points, done.before, done.accepted

        return jax.vmap(one)(partials, eyes)

    model = config.model
    framing = Framing(model.backbone.num_points, EMD_POINTS, model.margin)
    for start in range(0, count, batch_size):
        rows = np.arange(start, start + batch_size) % count
        examples = [with_partial(source[int(row)]) for row in rows]
        batch = stack([frame_example(example, framing) for example in examples])
        outputs = jax.device_get(complete(variables, batch.partial, batch.eye))
        kept = range(min(batch_size, count - start))
        yield [_scored(examples[i], batch, outputs, i, model.margin) for i in kept]


def _scored(
    example: Example, batch: Batch, outputs: tuple, i: int, margin: float
) -> Scored:
    points, before, accepted = outputs
    assert example.partial is not None and example.complete is not None
    center, scale = workspace_of(example.partial, margin)
    measured = (example.partial - center) / scale

    def merged(prediction: np.ndarray) -> np.ndarray:
        keep = keep_unmeasured(prediction, measured, batch.partial[i])
        return np.concatenate([measured, prediction[keep]])

    clouds = {
        "partial": measured,
        "output_before": before[i],
        "output": points[i],
        "merged_before": merged(before[i]),
        "merged": merged(points[i]),
    }
    clouds = {name: cloud * scale for name, cloud in clouds.items()}
    few = batch.complete[i] * scale
    complete = example.complete - center
    return Scored(clouds, complete, few, bool(accepted[i]), example.category)


def _score(scored: Scored) -> list[list[float]]:
    return [_metrics(cloud, scored) for cloud in scored.clouds.values()]


def _metrics(cloud: np.ndarray, scored: Scored) -> list[float]:
    complete, few = scored.complete, farthest_point_order(cloud, EMD_POINTS)
    return [
        metrics.cd_l2(cloud, complete),
        metrics.cd_l1(cloud, complete),
        metrics.f_score(cloud, complete),
        metrics.emd(few, scored.few),
        metrics.hausdorff(cloud, complete),
    ]


def _summary(
    values: Float[np.ndarray, "E K"], categories: np.ndarray, names: tuple[str, ...]
) -> dict[str, Any]:
    def means(rows: np.ndarray) -> dict[str, float]:
        return dict(zip(METRICS, rows.mean(0).tolist(), strict=True))

    low, high = _bootstrap(values)
    return {
        "mean": means(values),
        "median": dict(zip(METRICS, np.median(values, 0).tolist(), strict=True)),
        "interval": {name: [low[k], high[k]] for k, name in enumerate(METRICS)},
        "per_category": {
            name: means(values[categories == name])
            for name in names
            if (categories == name).any()
        },
    }


def _bootstrap(
    values: Float[np.ndarray, "E K"], num_resamples: int = 2000
) -> tuple[list[float], list[float]]:
    """95 % percentile interval of the mean over examples."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(values), (num_resamples, len(values)))
    means = np.stack([values[row].mean(0) for row in rows])
    low, high = np.quantile(means, [0.025, 0.975], axis=0)
    return low.tolist(), high.tolist()


ROWS = {
    "partial": "partial itself",
    "output_before": "network's output",
    "output": "network's output, adapted",
    "merged_before": "measured points kept",
    "merged": "measured points kept, adapted",
}

_COLUMNS = {
    "cd_l2": ("CD-L2 x1e4", 1e4),
    "cd_l1": ("CD-L1 x1e3", 1e3),
    "f_score": ("F@0.01", 1.0),
    "emd": ("EMD x1e2", 1e2),
    "hd": ("HD x1e2", 1e2),
}


def markdown(result: dict[str, Any]) -> str:
    """The result as tables: the means with their intervals, and CD-L2 by category."""
    heads = [head for head, _ in _COLUMNS.values()]
    lines = [_row(["", *heads]), _row(["---"] * (len(heads) + 1))]
    for name, label in ROWS.items():
        cells = []
        for metric, (_, factor) in _COLUMNS.items():
            low, high = (factor * bound for bound in result[name]["interval"][metric])
            mean = factor * result[name]["mean"][metric]
            cells.append(f"{mean:.4g} [{low:.4g}, {high:.4g}]")
        lines.append(_row([label, *cells]))
    categories = list(result["partial"]["per_category"])
    lines += ["", _row(["CD-L2 x1e4", *categories])]
    lines.append(_row(["---"] * (len(categories) + 1)))
    for name, label in ROWS.items():
        scores = result[name]["per_category"]
        cells = [f"{1e4 * scores[category]['cd_l2']:.4g}" for category in categories]
        lines.append(_row([label, *cells]))
    return "\n".join(lines) + "\n"


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
