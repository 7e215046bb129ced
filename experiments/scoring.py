"""What the launchers that score share: flags, frames, what they write."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import numpy as np
from absl import flags

from prism_jax.adaptation.config import PrismConfig
from prism_jax.data.datasets import (
    DATASETS,
    digest_of,
    open_dataset,
)
from prism_jax.data.source import Source
from prism_jax.evaluation import (
    NORMALISATIONS,
    CompleteFn,
    Protocol,
    comparison_markdown,
    evaluate,
)
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables, apply
from prism_jax.simulation.build_dataset import build_if_missing
from prism_jax.training.run import commit

FLAGS = flags.FLAGS


def define_scoring_flags(split: str | None, dataset: str = "shapes") -> None:
    """The flags of a launcher that scores, and what it scores on by default."""
    define_frame_flags(split, dataset)
    flags.DEFINE_integer("batch_size", 20, "Examples completed at once.", 1)
    flags.DEFINE_string("output", None, "JSON file to write; Markdown goes beside it.")


def define_frame_flags(
    split: str | None, dataset: str = "shapes", limit: int | None = None
) -> None:
    """The flags that say which frames, and how a network gets them."""
    flags.DEFINE_enum("dataset", dataset, DATASETS, "What to score on.")
    flags.DEFINE_string("data_dir", None, "Its folder; shapes and roboarm have one.")
    flags.DEFINE_string("split", split, "The data set's split.")
    flags.DEFINE_enum(
        "normalisation",
        None,
        NORMALISATIONS,
        "What frames the network's input: the partial cloud, the complete one as in "
        "the paper, or nothing; partial, or own if published.",
    )
    flags.DEFINE_integer("limit", limit, "The first so many examples only.", 1)


def open_split(split: str) -> Source:
    """The flags' data set, built where it is missing."""
    place = (FLAGS.dataset, split, FLAGS.data_dir)
    build_if_missing(*place)
    return open_dataset(*place)


def about_data(split: str) -> dict[str, Any]:
    """What names the examples."""
    digest = digest_of(FLAGS.dataset, split, FLAGS.data_dir)
    known = {} if digest is None else {"digest": digest}
    return {"data": FLAGS.dataset, "split": split, **known}


class Size(NamedTuple):
    """Points that a network reads and returns, and the margin of its workspace."""

    num_points: int
    num_outputs: int
    margin: float

    def __str__(self) -> str:
        return f"{self.num_points} points to {self.num_outputs}, margin {self.margin}"


def size_of(config: PrismConfig) -> Size:
    """Of PRISM's networks."""
    backbone = config.model.backbone
    return Size(backbone.num_points, backbone.stage_sizes[-1], config.model.margin)


def size_of_network(module: nn.Module, variables: Variables, margin: float) -> Size:
    """Of a network to compare with, which knows of no margin."""
    num_points: int = module.config.num_points  # pyright: ignore
    cloud = jax.ShapeDtypeStruct((1, num_points, 3), np.float32)
    stages = jax.eval_shape(lambda cloud: apply(module, variables, cloud), cloud)
    return Size(num_points, stages[-1].shape[1], margin)


def require_alike(sizes: Mapping[str, Size]) -> None:
    """Raises InputError, before hours of scoring, unless all are the first one's."""
    (first, wanted), *others = sizes.items()
    for name, found in others:
        if found != wanted:
            fault = f"is made for {found}, and {first} for {wanted}"
            raise InputError(name, fault, "compare weights of one size")


def make_protocol(config: PrismConfig, published: bool = False) -> Protocol:
    """What the flags say of frames and units; a published test needs no EMD."""
    default = "own" if published else "partial"
    return Protocol(
        config.model.backbone.num_points,
        config.model.margin,
        FLAGS.normalisation or default,
        unit="own" if published else "complete",
        with_emd=not published,
    )


def scored(complete_fn: CompleteFn, source: Source, protocol: Protocol) -> dict:
    """`evaluate` as the flags say."""
    return evaluate(complete_fn, source, protocol, FLAGS.limit, FLAGS.batch_size)


def named(protocol: Protocol) -> dict[str, Any]:
    """What names a comparison."""
    return {
        **about_data(FLAGS.split),
        "normalisation": protocol.normalisation,
        "commit": commit(),
    }


def deliver(result: Mapping[str, Any], table: str | None = None) -> None:
    """Prints the table, and writes both if --output says where."""
    table = comparison_markdown(result) if table is None else table
    print(table)
    if FLAGS.output is not None:
        path = pathlib.Path(FLAGS.output)
        write_bytes(path, json.dumps(result, indent=1).encode())
        write_bytes(path.with_suffix(".md"), table.encode())
