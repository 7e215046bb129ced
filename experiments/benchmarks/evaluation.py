"""Frames evaluated a second: many at once against one after the other."""

import time
from collections.abc import Iterator

from experiments.benchmarks.measure import Row, row
from prism_jax.adaptation.config import AdaptConfig
from prism_jax.data.recordings import RecordedCells
from prism_jax.data.source import Source
from prism_jax.evaluation import CompleteFn, Protocol, evaluate, prism_completer
from prism_jax.weights import load_pretrained

ROUNDS = 5
MOST = 1 / 5


def suite(weights: str = "small") -> Iterator[Row]:
    """The frames that ship, twenty at once and scored on all cores, against each
    completed and then scored alone; with and without the earth mover's distance."""
    config, variables = load_pretrained(weights)
    source = RecordedCells.bundled()
    completer = prism_completer(config, variables)
    for with_emd in (True, False):
        ours, theirs = [], []
        for counted in [False] + [True] * ROUNDS:
            times = _times(completer, config, source, with_emd)
            if counted:
                ours.append(times[0])
                theirs.append(times[1])
        suffix = "" if with_emd else " without EMD"
        name = f"{weights}, {len(source)} frames evaluated{suffix}"
        yield row(name, ours, "one after the other", theirs, MOST)


def _times(
    completer: CompleteFn, config: AdaptConfig, source: Source, with_emd: bool
) -> tuple[float, float]:
    """Milliseconds for all frames, at once and one after the other."""
    num_points, margin = config.model.backbone.num_points, config.model.margin
    protocol = Protocol(num_points, margin, with_emd=with_emd)
    taken = []
    for batch_size, workers in ((len(source), None), (1, 1)):
        start = time.perf_counter()
        evaluate(completer, source, protocol, None, batch_size, workers)
        taken.append(1e3 * (time.perf_counter() - start))
    return taken[0], taken[1]
