"""Fits the learned term to weights, and measures what it is worth elsewhere.

    python -m experiments.learned_term --weights=FILE --mixture=open:1,objects:1 \
        --data_dir=DATA --output=FILE.safetensors

The weights complete training views of the mixture, which they should not have seen: on
what they were trained on they are too good. From label-free geometry of each predicted
point (`prism_jax.losses.learned`) a small network learns the logarithm of its distance
from the true surface, by Adam. The same weights with it are written, and beside them
what it is worth on views that it was not fitted on: how well it foretells errors, and
how well its gradient in the point encoder agrees with that of CD-L2 to the truth.
"""

import json
import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from absl import flags
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from tqdm import tqdm

from experiments.adaptation import with_background
from experiments.boosting import rank_correlation
from experiments.loss_gradients import ERROR, agreement
from experiments.output import prepare_output
from experiments.weights import located
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import TOLERANCE, hold
from prism_jax.cli.launch import launch
from prism_jax.data.datasets import digest_of, open_dataset
from prism_jax.data.holdout import hold_out
from prism_jax.data.mixture import open_mixture, parse_mixture
from prism_jax.data.ordering import first_points
from prism_jax.data.pipeline import Framing, training_batches, with_partial
from prism_jax.data.source import Source
from prism_jax.evaluation.bootstrap import mean_intervals, resampled_means
from prism_jax.evaluation.protocol import (
    Protocol,
    observed,
    side_by_side,
    told,
    workspace_for,
)
from prism_jax.evaluation.tables import interval_text, percent, short, table_lines
from prism_jax.geometry.neighbors import nearest
from prism_jax.geometry.visibility import Visibility, spacing_of
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import chamfer
from prism_jax.losses.learned import error_clues
from prism_jax.losses.visibility import visibility_loss
from prism_jax.models.error_head import init_error_head, log_errors, with_term
from prism_jax.models.prism import NetworkInput, predict, prepare_input
from prism_jax.models.variables import Variables
from prism_jax.observation.observation import observe
from prism_jax.training.inputs import inputs_of
from prism_jax.training.optimisers import optimiser
from prism_jax.training.run import commit
from prism_jax.weights import load_pretrained, read_metadata, save_weights

FLAGS = flags.FLAGS

NUM_COMPLETE = 4096
"""Points of the truth that errors are measured to."""

LEAST = 5e-3
"""Half sides of the workspace, about half the spacing of those: an error of less is
taken for as much, before its logarithm is taken."""

HELD_OUT = "held out"
"""What the tables call the mixture's own objects that it was not fitted on."""

SETS = {
    "novel": ("shapes", "novel", False),
    "objects": ("objects", "validation", True),
    "cells": ("cells", "validation", True),
}
"""What it is measured on, by the names that tables give them: data set, split, and
whether it lies in the mixture's folder. None is a test."""

LOSSES = ("what was seen to be empty", "the learned term")
"""Whose gradients are compared with that of the error."""

ORACLE = "the error itself, which nobody knows"

ROWS = 8192
"""Points a step of the fit."""

BATCH = 20
"""Views completed at once."""


class Views(NamedTuple):
    """Clues and errors of points of some views.

    Attributes:
      clues: of some of each view's predicted points.
      wanted: logarithms of their errors, in half sides of the workspace.
    """

    clues: Float[np.ndarray, "V P C"]
    wanted: Float[np.ndarray, "V P"]


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "A name, or a file.")
    flags.DEFINE_string("mixture", None, "Sets to fit on, as open:1,objects:1.")
    flags.DEFINE_string("data_dir", None, "Their folder, and that of SETS' maps.")
    flags.DEFINE_integer("views", 4000, "Views to fit on.", 1)
    flags.DEFINE_integer("points", 256, "Points of each view.", 1)
    flags.DEFINE_integer("epochs", 20, "How often each point is seen.", 1)
    flags.DEFINE_float("learning_rate", 3e-3, "Of Adam, falling along a cosine.")
    flags.DEFINE_float("step_length", 0.1, "Of the steps that are measured.")
    flags.DEFINE_integer("limit", 100, "Views of each set to measure on.", 0)
    flags.DEFINE_integer("seed", 0, "Of the views' order, the points and the fit.")
    flags.DEFINE_string("output", None, "Weights to write; JSON goes beside them.")
    flags.mark_flags_as_required(["mixture", "output"])


def main() -> None:
    """Fits, writes, measures and prints."""
    prepare_output(FLAGS.output, ".safetensors")
    weights = located(FLAGS.weights)
    config, variables = load_pretrained(weights)
    if not config.model.backbone.reads_visibility:
        raise InputError(FLAGS.weights, "reads no visibility", "use weights that do")
    shares = parse_mixture(FLAGS.mixture)
    mixture, _ = open_mixture(shares, FLAGS.data_dir)
    train, held_out = hold_out(mixture, max(FLAGS.limit, 1))
    views = completed(config, variables, train, FLAGS.views, FLAGS.points, FLAGS.seed)
    params = fitted(views, FLAGS.epochs, FLAGS.learning_rate, FLAGS.seed)
    variables = with_term(variables, params)
    about = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "mixture": shares,
        "digests": {name: digest_of(name, "train", FLAGS.data_dir) for name in shares},
        "views": FLAGS.views,
        "points": FLAGS.points,
        "epochs": FLAGS.epochs,
        "learning_rate": FLAGS.learning_rate,
        "seed": FLAGS.seed,
    }
    known = {k: v for k, v in read_metadata(weights).items() if k != "config"}
    save_weights(FLAGS.output, config, variables, known | {"learned_term": about})
    print(f"written {FLAGS.output}")
    knowing = with_background(config, "empty")
    measure = jax.jit(
        jax.vmap(measured(knowing, FLAGS.step_length), (None, 0, 0, 0, 0))
    )
    result = about | {"error": ERROR, "step_length": FLAGS.step_length, "sets": {}}
    for name in (HELD_OUT, *SETS) if FLAGS.limit else ():
        source = held_out
        if name != HELD_OUT:
            dataset, split, beside = SETS[name]
            source = open_dataset(dataset, split, FLAGS.data_dir if beside else None)
        print(f"measuring on {name}", flush=True)
        found = worth(measure, knowing, variables, source, FLAGS.limit)
        result["sets"][name] = found
    table = worth_markdown(result)
    print(table)
    path = pathlib.Path(FLAGS.output)
    write_bytes(path.with_suffix(".json"), json.dumps(result, indent=1).encode())
    write_bytes(path.with_suffix(".md"), table.encode())


def completed(
    config: PrismConfig,
    variables: Variables,
    source: Source,
    count: int,
    num_points: int,
    seed: int,
) -> Views:
    """Completions of so many views, as training sees them: at random headings, every
    other with what its surface shows alone."""
    model = config.model
    framing = Framing(
        model.backbone.num_points, NUM_COMPLETE, model.margin, model.heading
    )
    size = min(BATCH, count)
    batches = training_batches(source, framing, size, seed)

    @jax.jit
    def points_of(variables: Variables, batch: Any, key: Array):
        inputs = inputs_of(batch, key, model)

        def one(inputs: NetworkInput, complete: Array, key: Array):
            points = predict(variables, inputs, model).points
            clues = clues_of(points, inputs)
            some = jax.random.permutation(key, len(points))[:num_points]
            return clues[some], _log_error(points[some], complete)

        keys = jax.random.split(key, len(batch.partial))
        return jax.vmap(one)(inputs, batch.complete, keys)

    rows = []
    starts = range(0, count, size)
    for start in tqdm(starts, desc="complete", unit="batch", mininterval=2.0):
        key = jax.random.fold_in(jax.random.key(seed), start)
        rows.append(jax.device_get(points_of(variables, next(batches), key)))
    clues, wanted = (np.concatenate(part)[:count] for part in zip(*rows, strict=True))
    return Views(clues, wanted)


def clues_of(points: Float[Array, "N 3"], inputs: NetworkInput) -> Float[Array, "N C"]:
    """What the learned term looks at, of a network that reads visibility."""
    assert inputs.visibility is not None
    eye = inputs.view.position
    return error_clues(points, inputs.partial, inputs.visibility, eye)


def _log_error(
    points: Float[Array, "N 3"], complete: Float[Array, "M 3"]
) -> Float[Array, " N"]:
    squared, _ = nearest(points, complete)
    return 0.5 * jnp.log(jnp.maximum(squared, LEAST**2))


def fitted(views: Views, epochs: int, learning_rate: float, seed: int) -> Variables:
    """Least squares by Adam; the same bits for the same views."""
    clues = jnp.asarray(views.clues.reshape(-1, views.clues.shape[-1]))
    wanted = jnp.asarray(views.wanted.reshape(-1))
    size = min(ROWS, len(clues))
    steps = len(clues) // size
    descent = optimiser("adam", learning_rate, epochs * steps, 0.01, 50, 1.0)
    first, order = jax.random.split(jax.random.key(seed))
    params = init_error_head(first)

    def loss(params: Variables, rows: Array) -> Float[Array, ""]:
        return jnp.mean((log_errors(params, clues[rows]) - wanted[rows]) ** 2)

    def step(state: tuple, rows: Array):
        params, moments = state
        value, grads = jax.value_and_grad(loss)(params, rows)
        updates, moments = descent.update(grads, moments, params)
        return (optax.apply_updates(params, updates), moments), value

    @jax.jit
    def epoch(state: tuple, key: Array):
        rows = jax.random.permutation(key, len(clues))[: steps * size]
        state, values = jax.lax.scan(step, state, rows.reshape(steps, size))
        return state, values.mean()

    state = params, descent.init(params)
    with tqdm(range(epochs), desc="fit", unit="epoch", mininterval=2.0) as bar:
        for number in bar:
            state, value = epoch(state, jax.random.fold_in(order, number))
            bar.set_postfix(loss=f"{float(value):.4f}")
    return state[0]


def worth(
    measure: Callable[..., tuple],
    config: PrismConfig,
    variables: Variables,
    source: Source,
    limit: int,
) -> dict[str, Any]:
    """How well the term foretells errors of views of a source, and which way its
    gradient points, as JSON; intervals are over objects and over kinds.

    `measure` is that of a batch (`measured`). The network is told what the source's
    maps say, or without maps what the configuration says of the background.
    """
    model, backbone = config.model, config.model.backbone
    protocol = Protocol(backbone.num_points, model.margin, heading=model.heading)
    count = min(limit, len(source))
    rows = np.linspace(0, len(source) - 1, count).astype(int)
    size = min(BATCH, count)
    expected, wanted, found, kinds = [], [], [], []
    starts = range(0, count, size)
    for start in tqdm(starts, desc="measure", unit="batch", mininterval=2.0):
        taken = rows[np.arange(start, start + size) % count]
        framed, own = zip(
            *(_framed(source[int(r)], protocol) for r in taken), strict=True
        )
        arrays = jax.tree.map(lambda *leaves: np.stack(leaves), *framed)
        batch = jax.device_get(measure(variables, *arrays))
        for into, part in zip((expected, wanted, found), batch, strict=True):
            into.extend(part[: count - start])
        kinds.extend(own[: count - start])
    objects = np.unique(source.objects[rows], return_inverse=True)[1]
    groups = {
        "interval": objects,
        "kind_interval": np.unique(kinds, return_inverse=True)[1],
    }
    pair = np.array(expected, np.float64), np.array(wanted, np.float64)
    return {
        "num_views": count,
        "num_objects": int(objects.max()) + 1,
        "num_kinds": int(groups["kind_interval"].max()) + 1,
        **_foretold(*pair, groups),
        "losses": _agreements(np.array(found, np.float64), groups),
    }


def _framed(
    example: Any, protocol: Protocol
) -> tuple[tuple[np.ndarray, np.ndarray, Visibility | None, np.ndarray], str]:
    """Partial, sensor's place, map and complete cloud in the workspace; the kind."""
    example = with_partial(example)
    few = first_points(example.complete, NUM_COMPLETE, example.ordered)
    complete = workspace_for(example, protocol).to_unit(few)
    (partial,), (eye,) = side_by_side([observed(example, protocol)])
    known = told(example, protocol).visibility
    return (partial, eye, known, np.asarray(complete, np.float32)), example.category


def measured(config: PrismConfig, step_length: float) -> Callable[..., tuple]:
    """A pure function of variables, partial, eye, map and complete cloud: expected and
    true logarithms of errors, and `agreement` of `LOSSES` and `ORACLE`."""

    def one(
        variables: Variables, partial: Array, eye: Array, known: Any, complete: Array
    ):
        camera = observe(partial, eye, Workspace.unit()).camera
        key = jax.random.key(config.adapt.seed)
        inputs = prepare_input(partial, camera, key, config.model, visibility=known)
        inputs = hold(variables, inputs, config.with_adapt(balance=False))
        params = variables["params"]
        start, unravel = ravel_pytree(params["point_encoder"])
        tolerance = TOLERANCE * spacing_of(partial)

        def points_of(flat: Array) -> Array:
            own = {**variables, "params": {**params, "point_encoder": unravel(flat)}}
            return predict(own, inputs, config.model).points

        def expected_of(points: Array) -> Array:
            return log_errors(params["learned"], clues_of(points, inputs))

        def values(flat: Array) -> Array:
            points = points_of(flat)
            terms = (
                visibility_loss(points, inputs.visibility, tolerance),
                expected_of(points).mean(),
                chamfer(points, complete),
            )
            return jnp.stack(terms)

        points = points_of(start)
        wanted = _log_error(points, complete)
        return expected_of(points), wanted, agreement(values, start, step_length)

    return one


def _foretold(
    expected: Float[np.ndarray, "V P"],
    wanted: Float[np.ndarray, "V P"],
    groups: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    """R^2 and rank correlations of logarithms of errors."""
    squares = (expected - wanted) ** 2, wanted, wanted**2
    columns = np.stack([part.mean(1) for part in squares], axis=1)

    def explained(means: np.ndarray) -> np.ndarray:
        off, first, second = means.T
        return 1.0 - off / (second - first**2)

    within = [rank_correlation(*pair) for pair in zip(expected, wanted, strict=True)]
    ranks = np.array([[0.0 if rank is None else rank] for rank in within])
    r2 = {"mean": float(explained(columns.mean(0, keepdims=True))[0])}
    rank = {"mean": float(ranks.mean())}
    for key, group in groups.items():
        drawn = explained(resampled_means(columns, group))
        r2[key] = np.quantile(drawn, (0.025, 0.975)).tolist()
        (low,), (high,) = mean_intervals(ranks, group)
        rank[key] = [low, high]
    pooled = rank_correlation(expected.ravel(), wanted.ravel())
    return {"r2": r2, "rank_within": rank, "rank_pooled": pooled}


def _agreements(
    found: Float[np.ndarray, "V 2 L"], groups: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Cosines, and relative changes of the error after a step: means with intervals."""
    flat = found.reshape(len(found), -1)
    bounds = {
        key: np.array(mean_intervals(flat, group)).reshape(2, *found.shape[1:])
        for key, group in groups.items()
    }
    result = {}
    for i, name in enumerate((*LOSSES, ORACLE)):
        row: dict[str, Any] = {"positive": float((found[:, 0, i] > 0).mean())}
        for j, what in enumerate(("cosine", "change")):
            row[what] = {"mean": float(found[:, j, i].mean())}
            row[what]["median"] = float(np.median(found[:, j, i]))
            row[what] |= {k: bound[:, j, i].tolist() for k, bound in bounds.items()}
        result[name] = row
    return result


def worth_markdown(result: Mapping[str, Any]) -> str:
    """A table of what is foretold, and one of the gradients of every set."""
    foretold, gradients = [], []
    for name, found in result["sets"].items():
        r2, rank = (_number(found[key]) for key in ("r2", "rank_within"))
        size = f"{found['num_views']} views, {found['num_kinds']} kinds"
        foretold.append([name, size, r2, rank, f"{found['rank_pooled']:.2f}"])
        for loss, row in found["losses"].items():
            change = row["change"]
            cells = [
                percent(change["mean"], change["interval"]),
                interval_text(change["kind_interval"]),
                f"{100 * change['median']:+.1f} %",
            ]
            share = f"{100 * row['positive']:.0f} %"
            gradients.append([name, loss, _number(row["cosine"]), share, *cells])
    length = f"CD-L2 after a step of {result['step_length']:g}"
    heads = (
        ["", "", "R2 of log errors", "rank, within views", "rank, all points"],
        [
            "",
            "gradient of",
            "cosine with CD-L2's",
            "positive",
            length,
            "kinds",
            "median",
        ],
    )
    mixture = ", ".join(
        f"{name}:{share:g}" for name, share in result["mixture"].items()
    )
    title = (
        f"A learned term of {result['weights']}, commit "
        f"{short(result['commit'] or 'unknown')}, fitted on {result['views']:,} views "
        f"of {mixture}. Intervals are over objects; kinds.\n"
    )
    tables = (
        table_lines(*pair) for pair in zip(heads, (foretold, gradients), strict=True)
    )
    return "\n".join([title, *(line for table in tables for line in [*table, ""])])


def _number(found: Mapping[str, Any]) -> str:
    intervals = (found[key] for key in ("interval", "kind_interval"))
    texts = (f"[{low:+.2f}, {high:+.2f}]" for low, high in intervals)
    return f"{found['mean']:+.2f} {'; '.join(texts)}"


def run() -> None:
    """The entry point."""
    define_flags()
    launch("learned_term", main)


if __name__ == "__main__":
    run()
