"""What steps at test time gain over being told what the sensor knows and over a filter.

python -m experiments.adaptation --split=unseen --output=tables/adaptation_unseen.json

Removed are predicted points that lie alone or outside the workspace, and those that
contradict the view (`prism_jax.selection`). Told is a network that gets the data's maps
of what the sensor knows, or, where the data keep none, that what lies around the object
is empty (`--background`). Blind is the same network given the surface that its cloud
shows and nothing of emptiness, which is what it has of a bare cloud, and what it had in
every other view that it was trained on; `--blind` names other weights for these rows.
The wrong sensor stands a quarter turn about the vertical away, for network and steps;
what is removed is decided from the right place. `--learned` names weights with a
learned term (`experiments.learned_term`, `experiments.meta_train`), which descend it as
their configuration and `--learned_set` say; `--rows` picks rows, each of which takes
its time. With `--measured` what a user gets is scored: the points that are added, and
the measured ones.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from experiments.comparison import Row, comparison, comparison_markdown
from experiments.output import prepare_output
from experiments.scoring import (
    define_scoring_flags,
    describe_run,
    in_one_pose,
    make_protocol,
    open_split,
    print_and_write,
    prism_size,
    require_equal_sizes,
    run_evaluation,
)
from experiments.settings import changed
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.inner_loop import step_sizes, unroll
from prism_jax.adaptation.objective import hold
from prism_jax.cli.launch import launch
from prism_jax.evaluation.paired import all_differences
from prism_jax.evaluation.protocol import Told
from prism_jax.evaluation.run import CompleteFn, Predictions, prism_completer
from prism_jax.evaluation.tables import LABELS, interval_text, percent, table_lines
from prism_jax.geometry.visibility import Background, turned
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import chamfer
from prism_jax.models.prism import predict, prepare_input
from prism_jax.models.variables import Variables, pop_encoders, put_encoders
from prism_jax.observation.observation import observe

FLAGS = flags.FLAGS

NEW = {
    "num_steps": 3,
    "step_size": 0.1,
    "clip_norm": 1.0,
    "depth_weight": 0.0,
    "auxiliary_weight": 0.0,
    "visibility_weight": 100.0,
    "keep_weight": 0.0,
    "balance": False,
}
"""The settings of adaptation that were chosen on every other shape of `novel`
(docs/findings.md)."""

BLIND, BLIND_REMOVED = "blind", "blind, removed"
TOLD, TOLD_REMOVED = "told", "told, removed"
PAPER = "told, adapted by the paper's objective, removed"
ADAPTED = "told, adapted by the new objective, removed"
WRONG = "told from a wrong sensor, removed"
WRONG_ADAPTED = "told from a wrong sensor, adapted by the new objective, removed"
LEARNED = "told, adapted by the learned term, removed"
PLANT = "adapted to the plant, told, removed"
ORACLE = "told, steps along the true gradient, removed"

PAIRS = (
    (BLIND, TOLD_REMOVED),
    (BLIND, BLIND_REMOVED),
    (BLIND_REMOVED, TOLD_REMOVED),
    (TOLD_REMOVED, PAPER),
    (TOLD_REMOVED, ADAPTED),
    (PAPER, ADAPTED),
    (TOLD_REMOVED, LEARNED),
    (WRONG, WRONG_ADAPTED),
    (TOLD_REMOVED, PLANT),
    (TOLD_REMOVED, ORACLE),
)
"""Rows whose differences answer something."""

ROWS = {
    "blind": (BLIND, BLIND_REMOVED, TOLD),
    "paper": (PAPER,),
    "new": (ADAPTED,),
    "learned": (LEARNED,),
    "wrong": (WRONG_ADAPTED,),
    "oracle": (ORACLE,),
    "plant": (PLANT,),
}
"""Names of rows for the flag; told and removed comes with every other."""

QUARTER_TURN = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.float32)
"""Of points as rows, about the vertical."""


def define_flags() -> None:
    """The flags of this launcher."""
    define_scoring_flags(split="unseen")
    flags.DEFINE_string("weights", "small", "Released weights, by name or by file.")
    flags.DEFINE_string("blind", None, "Others for the blind rows.")
    flags.DEFINE_string("plant", None, "The weights, adapted to the plant.")
    flags.DEFINE_string("learned", None, "The weights, with a learned term.")
    flags.DEFINE_multi_string("learned_set", [], "Changes to how those adapt.")
    flags.DEFINE_multi_enum("rows", [*ROWS], [*ROWS], "Which rows to score.")
    flags.DEFINE_bool("measured", False, "Score added and measured points together.")
    flags.DEFINE_enum(
        "background",
        "empty",
        ["unknown", "empty"],
        "What lies around the objects of data without maps.",
    )
    flags.DEFINE_multi_string(
        "set", [], "Changes to the new objective, as adapt.field=value."
    )


def main() -> None:
    """Scores every row, and prints and writes what differs between them."""
    prepare_output(FLAGS.output, ".json")
    own, variables = in_one_pose(FLAGS.weights)
    new = changed(own.with_adapt(**NEW), FLAGS.set)
    others = {
        label: in_one_pose(name)
        for label, name in (
            (BLIND, FLAGS.blind),
            (PLANT, FLAGS.plant),
            (LEARNED, FLAGS.learned),
        )
        if name is not None
    }
    wanted = {label for name in FLAGS.rows for label in ROWS[name]}
    wanted -= {PLANT, LEARNED} - others.keys()
    if not wanted & {PAPER, ADAPTED, LEARNED, ORACLE}:
        fault = "none of them says what the network is before it adapts"
        raise InputError("--rows", fault, "add one of paper, new, learned or oracle")
    sizes = {FLAGS.weights: prism_size(own)}
    sizes |= {label: prism_size(config) for label, (config, _) in others.items()}
    require_equal_sizes(sizes)
    source = open_split(FLAGS.split)
    protocol = dataclasses.replace(
        make_protocol(own), with_measured=FLAGS.measured, with_emd=False
    )
    cloud = "completed" if FLAGS.measured else "network"

    def score(
        complete: CompleteFn, config: PrismConfig, **settings: bool
    ) -> dict[str, Any]:
        of_row = dataclasses.replace(
            protocol,
            heading=config.model.heading,
            background=FLAGS.background,
            **settings,
        )
        return run_evaluation(complete, source, of_row)

    def unadapted(config: PrismConfig, variables: Variables) -> CompleteFn:
        return prism_completer(config.with_adapt(num_steps=0), variables)

    config, weights = others.get(BLIND, (own, variables))
    blind = unadapted(with_background(config, "unknown"), weights)
    told = with_background(own, FLAGS.background)
    new = with_background(new, FLAGS.background)
    rows = {}
    if BLIND in wanted:
        rows[BLIND] = Row(score(blind, config), cloud)
        rows[BLIND_REMOVED] = Row(score(blind, config, removes=True), cloud)
        rows[TOLD] = Row(score(unadapted(told, variables), told, told=True), cloud)
    adapted = prism_completer(new, variables)
    completers = [
        (TOLD_REMOVED, PAPER, prism_completer(told, variables)),
        (TOLD_REMOVED, ADAPTED, adapted),
        (WRONG, WRONG_ADAPTED, from_wrong_sensor(adapted)),
        (TOLD_REMOVED, ORACLE, oracle_completer(new, variables)),
    ]
    settings = {"new": new.adapt}
    if LEARNED in others:
        config, weights = others[LEARNED]
        config = with_background(changed(config, FLAGS.learned_set), FLAGS.background)
        completers.append((TOLD_REMOVED, LEARNED, prism_completer(config, weights)))
        settings["learned"] = config.adapt
    for before, after, complete in completers:
        if after not in wanted:
            continue
        result = score(complete, own, told=True, removes=True)
        rows.setdefault(before, Row(result, f"{cloud}_unadapted"))
        rows[after] = Row(result, cloud)
    if PLANT in wanted:
        config, weights = others[PLANT]
        plant = unadapted(with_background(config, FLAGS.background), weights)
        rows[PLANT] = Row(score(plant, config, told=True, removes=True), cloud)

    about = describe_run(protocol) | {"weights": FLAGS.weights}
    for name, adapt in settings.items():
        about[name] = {
            field: getattr(adapt, field) for field in (*NEW, "learned_weight")
        }
    table = comparison(rows, TOLD_REMOVED, **about)
    table["pairs"] = differences(rows)
    print_and_write(table, markdown(table))


def with_background(config: PrismConfig, background: Background) -> PrismConfig:
    """The same networks, told this of what lies around a cloud without a map."""
    return config.with_model(background=background)


def from_wrong_sensor(complete: Callable[..., Predictions]) -> CompleteFn:
    """A completer whose sensor, and what that knows, is turned by `QUARTER_TURN`."""

    def wrong(partials: np.ndarray, eyes: np.ndarray, told: Told) -> Predictions:
        known = told.visibility
        if known is not None:
            known = turned(known, QUARTER_TURN)
        return complete(partials, eyes @ QUARTER_TURN, told._replace(visibility=known))

    return wrong


def oracle_completer(config: PrismConfig, variables: Variables) -> CompleteFn:
    """Steps along the gradient of CD-L2 to the truth, as many and as long as the
    configuration's; each frame's loss is scaled so that its first gradient has the
    length one. What no label-free objective can exceed in its first step."""

    def one(partial: Array, eye: Array, told: Told):
        camera = observe(partial, eye, Workspace.unit()).camera
        key = jax.random.key(config.adapt.seed)
        inputs = prepare_input(
            partial, camera, key, config.model, visibility=told.visibility
        )
        inputs = hold(variables, inputs, config.with_adapt(balance=False))
        encoders, rest = pop_encoders(variables)

        def points(encoders: Variables) -> Array:
            whole = put_encoders(encoders, rest)
            return predict(whole, inputs, config.model).points

        def error(encoders: Variables) -> Array:
            return chamfer(points(encoders), told.complete)

        norm = jnp.linalg.norm(ravel_pytree(jax.grad(error)(encoders))[0])
        adapted, _ = unroll(
            lambda encoders: (error(encoders) / jnp.maximum(norm, 1e-9), ()),
            encoders,
            step_sizes(variables, config.adapt),
            config.adapt.num_steps,
            clip_norm=config.adapt.clip_norm,
        )
        return points(adapted), points(encoders), jnp.bool_(True)

    batched = jax.jit(jax.vmap(one))
    return lambda partials, eyes, told: Predictions(*batched(partials, eyes, told))


def differences(rows: Mapping[str, Row]) -> list[dict[str, Any]]:
    """What changes between two rows, for those of `PAIRS` that there are."""
    return [
        {
            "row": after,
            "against": before,
            "change": all_differences(
                rows[before].result,
                rows[after].result,
                (rows[before].cloud, rows[after].cloud),
            ),
        }
        for before, after in PAIRS
        if before in rows and after in rows
    ]


def markdown(table: Mapping[str, Any]) -> str:
    """Scores with the change against told and removed, and then every pair of rows."""
    names = list(table["pairs"][0]["change"])
    lines = []
    for pair in table["pairs"]:
        cells = []
        for name in names:
            found = pair["change"][name]
            cell = percent(found["change"], found["interval"])
            if "category_interval" in found:
                over = interval_text(found["category_interval"])
                cell += f"; over {found['num_categories']} categories {over}"
            cells.append(cell)
        lines.append([pair["row"], pair["against"], *cells])
    head = ["", "against", *(LABELS[name] for name in names)]
    told = [
        f"The {name} objective: "
        + ", ".join(f"{field} {value}" for field, value in table[name].items())
        + ".\n"
        for name in ("new", "learned")
        if name in table
    ]
    parts = [comparison_markdown(table), *told, *table_lines(head, lines), ""]
    return "\n".join(parts)


def run() -> None:
    """The entry point."""
    define_flags()
    launch("adaptation", main)


if __name__ == "__main__":
    run()
