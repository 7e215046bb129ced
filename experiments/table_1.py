"""Table I: PRISM, other networks, and baselines without a network.

python -m experiments.table_1 --split=test --output=tables/table_1.json

`experiments/train_table_1.sh` trains all of them on equally many samples.
"""

import contextlib
import dataclasses
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from absl import flags

from experiments.baselines.trivial import mirrored, training_mean
from experiments.baselines.weights import load_network, with_weights
from experiments.comparison import Row, comparison, comparison_markdown
from experiments.output import prepare_output
from experiments.paired import NoChangeError, all_differences, paired_difference
from experiments.scored_run import CompleteFn, Predictions
from experiments.scoring import (
    define_scoring_flags,
    describe_run,
    in_one_pose,
    make_protocol,
    network_size,
    open_split,
    print_and_write,
    prism_completer,
    prism_size,
    require_equal_sizes,
    run_evaluation,
)
from experiments.splits import training_split
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import read_metadata, samples_seen
from prism_jax.evaluation.tables import COLUMNS, change_cells, score_cells, table_lines
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables, apply

FLAGS = flags.FLAGS
LABELS = {"pcn": "PCN", "pointr": "PoinTr", "seedformer": "SeedFormer", "fsc": "FSC"}
BACKBONE = "CRA-PCN"
OURS = "PRISM, not adapted"
TOLD = "PRISM, told, not adapted"
"""No other row is told the map of the whole scan. Only where the source has maps."""
COMPARED = {column.metric: column for column in COLUMNS}
"""By what ours is set beside the best of the others."""
HIGHER = ("f_score", "f_2", "precision_2", "recall_2")  # is better


def define_flags() -> None:
    """The flags of this launcher."""
    define_scoring_flags(split="test")
    flags.DEFINE_string("weights", "prism", "PRISM weights, name or file.")
    flags.DEFINE_string(
        "backbone",
        "crapcn",
        "Weights of the backbone without visibility, name or file.",
    )
    flags.DEFINE_multi_string(
        "network", None, "Other networks, name or file. Default: all with weights here."
    )
    flags.DEFINE_multi_string(
        "longer", [], "PRISM weights trained for longer, in extra rows."
    )


def main():
    """Scores every row on the same examples, input and output counts."""
    prepare_output(FLAGS.output, ".json")
    config, variables = in_one_pose(FLAGS.weights)
    alone, backbone = in_one_pose(FLAGS.backbone)
    names = with_weights() if FLAGS.network is None else FLAGS.network
    others = {name: load_network(name) for name in names}
    longer = {name: in_one_pose(name) for name in FLAGS.longer}
    for name, (own, _) in longer.items():
        if own.model.heading != config.model.heading:
            fault = f"assumes other headings than {FLAGS.weights}"
            raise InputError(name, fault, "compare weights with the same heading")
    sizes = {FLAGS.weights: prism_size(config), FLAGS.backbone: prism_size(alone)}
    sizes |= {name: prism_size(own) for name, (own, _) in longer.items()}
    for name, (module, own) in others.items():
        sizes[name] = network_size(module, own, config.model.margin)
    require_equal_sizes(sizes)
    source, protocol = open_split(FLAGS.split), make_protocol(config)
    num_outputs = config.model.backbone.stage_sizes[-1]
    training = open_split(training_split(FLAGS.dataset))
    mean = training_mean(training, protocol.margin, num_outputs)

    mirror = jax.jit(lambda partials: mirrored(partials, num_outputs))

    def run(complete_fn, told=False):
        without = dataclasses.replace(
            protocol, with_measured=False, uses_visibility=told
        )
        return run_evaluation(complete_fn, source, without)

    adapted = run_evaluation(prism_completer(config, variables), source, protocol)
    rows = {
        "partial": Row(adapted, "partial"),
        "training mean": Row(
            run(lambda partials, _: Predictions(np.stack([mean] * len(partials))))
        ),
        "partial and its mirror image": Row(
            run(lambda partials, _: Predictions(mirror(partials)))
        ),
    }
    for name, (module, own) in others.items():
        found = run(network_completer(module, own))
        label = LABELS[read_metadata(located(name))["network"]]
        rows[label] = Row(found, "network", count(own), seen(name))
    alone = alone.with_adapt(num_steps=0)
    found = run(prism_completer(alone, backbone))
    number = count(backbone, "point_encoder", "decoder")
    rows[BACKBONE] = Row(found, "network", number, seen(FLAGS.backbone))
    number, samples = count(variables), seen(FLAGS.weights)
    rows[OURS] = Row(adapted, "network_unadapted", number, samples)
    rows["PRISM"] = Row(adapted, "network", number, samples)
    if source[0].visibility is not None:
        found = run(
            prism_completer(config.with_adapt(num_steps=0), variables), told=True
        )
        rows[TOLD] = Row(found, "network", number, samples)
    for name, (own, trained) in longer.items():
        found = run(prism_completer(own.with_adapt(num_steps=0), trained))
        number = count(trained)
        rows[f"{name}, not adapted"] = Row(found, "network", number, seen(name))
    about = describe_run(protocol) | {
        "weights": FLAGS.weights,
        "steps": config.adapt.num_steps,
    }
    table = comparison(rows, BACKBONE, **about)
    given = {name: rows[name] for name in (*LABELS.values(), BACKBONE) if name in rows}
    table["best_others"] = best_others(given, rows[OURS])
    if TOLD in rows:
        clouds = (rows[OURS].cloud, rows[TOLD].cloud)
        results = (rows[OURS].result, rows[TOLD].result)
        table["told"] = all_differences(*results, clouds)
    print_and_write(table, table_markdown(table))


def network_completer(module: nn.Module, variables: Variables) -> CompleteFn:
    """A network that maps partials to its stages, the last of which is scored; jitted,
    and compiled for each batch size."""
    batched = jax.jit(lambda variables, partials: apply(module, variables, partials))
    return lambda partials, eyes: Predictions(batched(variables, partials)[-1])


def best_others(others: Mapping[str, Row], ours: Row) -> dict[str, Any]:
    """Of each metric's means the ``row`` that is the best of others, and the ``change``
    from it to ours (`paired_difference`); as JSON."""
    found = {}
    for metric in COMPARED:
        means = {
            label: row.result["clouds"][row.cloud]["mean"].get(metric)
            for label, row in others.items()
        }
        if None in means.values():
            continue
        best = (max if metric in HIGHER else min)(means, key=means.get)  # pyright: ignore
        results = others[best].result, ours.result
        clouds = others[best].cloud, ours.cloud
        with contextlib.suppress(NoChangeError):  # from an F of 0
            change = paired_difference(*results, metric, clouds)
            found[metric] = {"row": best, "change": change}
    return found


def table_markdown(table: Mapping[str, Any]) -> str:
    """All rows, and ours beside the best of the others, a line for each metric."""
    found = table["best_others"]
    changes = {metric: best["change"] for metric, best in found.items()}
    heads, cells = change_cells(changes, "change")
    lines = []
    for (metric, told), change in zip(found.items(), cells, strict=True):
        column, best = COMPARED[metric], told["row"]
        shown = [score_cells(table["rows"][name], [column])[0] for name in (best, OURS)]
        lines.append([column.head, best, *shown, *change])
    head = ["", "best of the others", "its score", OURS, *heads]
    return "\n".join([comparison_markdown(table), *table_lines(head, lines), ""])


def count(variables: Variables, *parts: str) -> int:
    """Parameters, of these modules or of all."""
    params = variables["params"]
    chosen = [params[name] for name in parts] if parts else params
    return sum(leaf.size for leaf in jax.tree.leaves(chosen))


def seen(weights: str) -> int:
    """Samples that these weights were trained on."""
    return samples_seen(read_metadata(located(weights)))


def run():
    """The entry point."""
    define_flags()
    launch("table_1", main)


if __name__ == "__main__":
    run()
