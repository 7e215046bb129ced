"""Frames evaluated a second: many at once against one after the other."""

import functools
from collections.abc import Iterator

from experiments.benchmarks.measure import Row, in_turn, row
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation import Protocol, evaluate, prism_completer
from prism_jax.weights import load_pretrained

MOST = 1 / 5


def suite(weights: str = "small") -> Iterator[Row]:
    """The frames that ship, twenty at once and scored on all cores, against each
    completed and then scored alone; with and without the earth mover's distance."""
    config, variables = load_pretrained(weights)
    source = RecordedCells.bundled()
    completer = prism_completer(config, variables)
    sizes = config.model.backbone.num_points, config.model.margin
    for with_emd in (True, False):
        protocol = Protocol(*sizes, with_emd=with_emd)
        run = functools.partial(evaluate, completer, source, protocol)
        ours, theirs = in_turn(
            lambda run=run: run(batch_size=len(source)),
            lambda run=run: run(batch_size=1, num_workers=1),
        )
        suffix = "" if with_emd else " without EMD"
        name = f"{weights}, {len(source)} frames evaluated{suffix}"
        yield row(name, ours, "one after the other", theirs, MOST)
