"""What the commands that score share: flags, how examples are framed, output."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import numpy as np
from absl import flags
from jaxtyping import Array

from experiments.comparison import comparison_markdown
from experiments.protocol import NORMALISATIONS, Protocol
from experiments.run_folder import commit
from experiments.scored_run import CompleteFn, Predictions, evaluate
from experiments.simulation.build_dataset import build_if_missing
from experiments.splits import digest_of
from experiments.weights import located
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.completion.weights import load_pretrained
from prism_jax.data.datasets import DATASETS, open_dataset
from prism_jax.data.source import Source
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables, apply
from prism_jax.preprocessing.observation import framed_view
from prism_jax.uncertainty.evidence import LOOKS

FLAGS = flags.FLAGS


def define_scoring_flags(split: str | None, dataset: str = "shapes") -> None:
    """The flags of a command that scores; the arguments are defaults."""
    define_frame_flags(split, dataset)
    flags.DEFINE_integer("batch_size", 20, "Examples completed at once.", 1)
    flags.DEFINE_string("output", None, "JSON file to write.")


def define_frame_flags(
    split: str | None, dataset: str = "shapes", limit: int | None = None
) -> None:
    """The flags that choose examples and how a network's input is framed."""
    flags.DEFINE_enum("dataset", dataset, DATASETS, "Data set to score on.")
    flags.DEFINE_string("data_dir", None, "Folder of the data set.")
    flags.DEFINE_string("split", split, "Split of the data set.")
    flags.DEFINE_enum(
        "normalisation",
        None,
        NORMALISATIONS,
        "Normalise the input by the partial cloud, the complete one (as in the paper) "
        "or not at all. Default: partial, or own if published.",
    )
    flags.DEFINE_integer(
        "limit", limit, "Number of examples to use, from the first on.", 1
    )


def open_split(split: str) -> Source:
    """The data set that the flags name; a generated one is built if it is missing."""
    place = (FLAGS.dataset, split, FLAGS.data_dir)
    build_if_missing(*place)
    return open_dataset(*place)


def describe_data(split: str) -> dict[str, Any]:
    """The part of a result that says what it was scored on.

    `digest` differs between builds of one split whose files differ.
    """
    digest = digest_of(FLAGS.dataset, split, FLAGS.data_dir)
    known = {} if digest is None else {"digest": digest}
    return {"data": FLAGS.dataset, "split": split, **known}


class NetworkSize(NamedTuple):
    """How many points a network reads and returns, and the margin of its workspace."""

    num_points: int
    num_outputs: int
    margin: float

    def __str__(self) -> str:
        return f"{self.num_points} points to {self.num_outputs}, margin {self.margin}"


def prism_size(config: PrismConfig) -> NetworkSize:
    """The size of a PRISM network."""
    model = config.model
    return NetworkSize(model.backbone.num_points, model.num_points, model.margin)


def network_size(module: nn.Module, variables: Variables, margin: float) -> NetworkSize:
    """The size of a baseline, which has no margin of its own."""
    num_points: int = module.config.num_points  # pyright: ignore
    cloud = jax.ShapeDtypeStruct((1, num_points, 3), np.float32)
    stages = jax.eval_shape(lambda cloud: apply(module, variables, cloud), cloud)
    return NetworkSize(num_points, stages[-1].shape[1], margin)


def in_one_pose(weights: str) -> tuple[PrismConfig, Variables]:
    """Weights, by name or by file, that complete a frame in its own pose alone
    (`ModelConfig.poses`): where networks are compared, all have as many points."""
    config, variables = load_pretrained(located(weights))
    return config.with_model(poses=1), variables


def require_equal_sizes(sizes: Mapping[str, NetworkSize]) -> None:
    """Raises InputError before hours of scoring if the sizes differ."""
    (first, wanted), *others = sizes.items()
    for name, found in others:
        if found != wanted:
            fault = f"made for {found}, but {first} for {wanted}"
            raise InputError(name, fault, "compare weights of the same size")


def require_looks(weights: str, config: PrismConfig) -> None:
    """InputError unless weights complete in the poses that a verdict compares."""
    if config.model.poses < LOOKS:
        fault = f"uses fewer than the {LOOKS} poses needed for a confidence"
        remedy = f"release it with --set=model.poses={LOOKS} first"
        raise InputError(weights, fault, remedy)


def make_protocol(config: PrismConfig, published: bool = False) -> Protocol:
    """The protocol that the flags ask for; published tests report no EMD."""
    default = "own" if published else "partial"
    return Protocol(
        config.model.backbone.num_points,
        config.model.margin,
        FLAGS.normalisation or default,
        unit="own" if published else "complete",
        with_emd=not published,
        heading=config.model.heading,
        background=config.model.background,
    )


def run_evaluation(complete_fn: CompleteFn, source: Source, protocol: Protocol) -> dict:
    """`evaluate` with the flags' limit and batch size."""
    return evaluate(complete_fn, source, protocol, FLAGS.limit, FLAGS.batch_size)


def describe_run(protocol: Protocol) -> dict[str, Any]:
    """The part of a result that says what it was made from."""
    return {
        **describe_data(FLAGS.split),
        "normalisation": protocol.normalisation,
        "commit": commit(),
    }


def print_and_write(result: Mapping[str, Any], table: str | None = None) -> None:
    """Prints the table; with --output, writes the result."""
    print(comparison_markdown(result) if table is None else table)
    write_result(result)


def write_result(result: Mapping[str, Any]) -> None:
    """With --output, writes the result."""
    if FLAGS.output is not None:
        write_bytes(FLAGS.output, json.dumps(result, indent=1).encode())


def prism_completer(config: PrismConfig, variables: Variables) -> CompleteFn:
    """PRISM with its test-time adaptation, jitted; compiled for each batch size. With
    ``num_steps=0`` it returns ``network`` alone. Without maps it has what the clouds
    say."""
    adapt = make_adapt(config)

    def one(variables: Variables, partial: Array, eye: Array, visibility: Any):
        camera = framed_view(partial, eye)
        done = adapt(variables, partial, camera, visibility)
        if config.adapt.num_steps == 0:
            return done.points, None, None
        return done.points, done.before, done.accepted

    batched = jax.jit(jax.vmap(one, (None, 0, 0, 0)))

    def complete(partials, eyes, visibility=None) -> Predictions:
        return Predictions(*batched(variables, partials, eyes, visibility))

    return complete
