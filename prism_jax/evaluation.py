"""Scores of a completer on a split of the corpus.

Every example is framed by its partial alone, as a deployment would, and scored in the
frame of the examples, where the longest side of the complete cloud spans [-1, 1].
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
from prism_jax.data.corpus import Examples
from prism_jax.data.partials import farthest_point_order
from prism_jax.geometry.camera import Camera
from prism_jax.models.variables import Variables
from prism_jax.training.batches import Batch, make_batch

EMD_POINTS = 1024
"""The exact earth mover's distance is taken between so many farthest points."""

METRICS = ("cd_l2", "cd_l1", "f_score", "emd", "hd")


class Scored(NamedTuple):
    """Clouds of one example, in its stored frame, and what they are scored against."""

    clouds: dict[str, Float[np.ndarray, "_ 3"]]
    complete: Float[np.ndarray, "M 3"]
    accepted: bool


def evaluate(
    config: AdaptConfig,
    variables: Variables,
    examples: Examples,
    batch_size: int = 20,
    num_workers: int = 2,
) -> dict[str, Any]:
    """Scores of the partial, the network's output and the merged cloud.

    ``output`` and ``merged`` come with ``_before`` for the network as it was. Each has
    the mean of every metric, its bootstrap 95 % interval over the examples, and the
    means by category; ``accepted`` is the share of frames whose adaptation was.
    """
    count = len(examples.partial)
    names: list[str] = []
    values, accepted = [], []
    context = multiprocessing.get_context("spawn")
    completed = _complete(config, variables, examples, batch_size)
    with (
        tqdm(total=count, desc="evaluate", unit="shape", mininterval=2.0) as bar,
        concurrent.futures.ProcessPoolExecutor(num_workers, context) as pool,
    ):
        for batch in completed:
            names = list(batch[0].clouds)
            accepted += [scored.accepted for scored in batch]
            for row in pool.map(_score, batch):
                values.append(row)
                bar.update()
    table = np.array(values)
    categories = np.asarray(examples.category)
    return {
        "num_examples": count,
        "accepted": float(np.mean(accepted)),
        **{
            name: _summary(table[:, i], categories, examples.categories)
            for i, name in enumerate(names)
        },
    }


def _complete(
    config: AdaptConfig, variables: Variables, examples: Examples, batch_size: int
) -> Iterator[list[Scored]]:
    adapt = make_adapt(config)

    @jax.jit
    def complete(variables, partials, eyes):
        def one(partial, eye):
            done = adapt(variables, partial, Camera.framing(partial, eye))
            return done.points, done.before, done.accepted

        return jax.vmap(one)(partials, eyes)

    count = len(examples.partial)
    num_measured = examples.partial.shape[1]
    num_complete = examples.complete.shape[1]
    for start in range(0, count, batch_size):
        rows = np.arange(start, start + batch_size) % count
        batch = make_batch(
            examples, rows, num_measured, num_complete, config.model.margin
        )
        # Stored partials are in farthest-point order: their prefix is the sample.
        partial = batch.partial[:, : config.model.backbone.num_points]
        outputs = jax.device_get(complete(variables, partial, batch.eye))
        kept = min(batch_size, count - start)
        yield [_scored(batch, partial, outputs, i) for i in range(kept)]


def _scored(batch: Batch, partial: np.ndarray, outputs: tuple, i: int) -> Scored:
    points, before, accepted = outputs
    measured, scale = batch.partial[i], batch.half_extent[i]

    def merged(prediction: np.ndarray) -> np.ndarray:
        keep = keep_unmeasured(prediction, measured, partial[i])
        return np.concatenate([measured, prediction[keep]])

    clouds = {
        "partial": measured,
        "output_before": before[i],
        "output": points[i],
        "merged_before": merged(before[i]),
        "merged": merged(points[i]),
    }
    clouds = {name: cloud * scale for name, cloud in clouds.items()}
    return Scored(clouds, batch.complete[i] * scale, bool(accepted[i]))


def _score(scored: Scored) -> list[list[float]]:
    return [_metrics(cloud, scored.complete) for cloud in scored.clouds.values()]


def _metrics(cloud: np.ndarray, complete: np.ndarray) -> list[float]:
    few = farthest_point_order(cloud, EMD_POINTS)
    return [
        metrics.cd_l2(cloud, complete),
        metrics.cd_l1(cloud, complete),
        metrics.f_score(cloud, complete),
        metrics.emd(few, complete[:EMD_POINTS]),
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
            name: means(values[categories == i])
            for i, name in enumerate(names)
            if (categories == i).any()
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
