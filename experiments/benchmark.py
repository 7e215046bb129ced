"""Speed and memory against other implementations, by suite.

python -m experiments.benchmark --suite=SUITE [--of=NAME] --output=FILE.json
"""

import dataclasses
import importlib
import inspect
import json

from absl import flags

from experiments.benchmarks.measure import Row
from experiments.output import prepare_output
from prism_jax.cli.launch import launch
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError

FLAGS = flags.FLAGS
SUITES = (
    "ops",
    "kernels",
    "adapt",
    "evaluation",
    "training",
    "startup",
    "memory",
    "stream",
)
HEADER = (
    "| what | ours | peer | its | ratio | target | holds | compile s | MiB |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_enum("suite", "ops", SUITES, "Benchmarks to run.")
    flags.DEFINE_string(
        "of",
        None,
        "Preset (training, memory), weights (evaluation, stream), either (adapt), or a "
        "scan of a scene (startup). Default: small, paper for memory, no scan.",
    )
    flags.DEFINE_string("output", None, "JSON file to write.")


def main():
    """Prints each row when it is measured; the machine should be otherwise idle."""
    prepare_output(FLAGS.output, ".json")
    suite = importlib.import_module(f"experiments.benchmarks.{FLAGS.suite}").suite
    given = [] if FLAGS.of is None else [FLAGS.of]
    if given and not inspect.signature(suite).parameters:
        raise InputError("--of", f"not used by {FLAGS.suite}", "omit it")
    rows = []
    print(HEADER, flush=True)
    for row in suite(*given):
        rows.append(dataclasses.asdict(row))
        print(markdown(row), flush=True)
    if FLAGS.output is not None:
        write_bytes(FLAGS.output, json.dumps(rows, indent=1).encode())


def markdown(row: Row) -> str:
    """A row of the table."""
    low, high = row.spread
    cells = [
        row.name,
        f"{row.ours:.4g} {row.unit} ({low:.4g} to {high:.4g})",
        row.peer,
        f"{row.theirs:.4g} {row.unit}",
        f"{row.ratio:.3g}",
        "" if row.target is None else f"{row.target:g}",
        "" if row.holds is None else "yes" if row.holds else "no",
        "" if row.compile_seconds is None else f"{row.compile_seconds:.2g}",
        "" if row.peak_mib is None else f"{row.peak_mib:.3g}",
    ]
    return f"| {' | '.join(cells)} |"


def run():
    """The entry point."""
    define_flags()
    launch("benchmark", main)


if __name__ == "__main__":
    run()
