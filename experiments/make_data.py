"""Builds the procedural corpus: python -m experiments.make_data --split=all"""

import dataclasses
import sys
from typing import Any

from absl import app, flags

from prism_jax.data.corpus import SPLITS, CorpusConfig, build_corpus
from prism_jax.io.errors import InputError

_SPLIT = flags.DEFINE_enum("split", "all", [*SPLITS, "all"], "Split to build.")
_CACHE_DIR = flags.DEFINE_string(
    "cache_dir", None, "Where splits are kept; by default the user's cache folder."
)
_WORKERS = flags.DEFINE_integer(
    "num_workers", None, "Processes; by default the number of cores.", lower_bound=0
)
_SIZES = {
    name: flags.DEFINE_integer(name, default, f"CorpusConfig.{name}")
    for name, default in dataclasses.asdict(CorpusConfig()).items()
}


def main(argv: list[str]) -> None:
    """Builds the splits that are asked for and prints their folders."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument {argv[1]!r}")
    sizes: dict[str, Any] = {name: flag.value for name, flag in _SIZES.items()}
    try:
        config = CorpusConfig(**sizes)
        for split in SPLITS if _SPLIT.value == "all" else [_SPLIT.value]:
            print(build_corpus(split, config, _CACHE_DIR.value, _WORKERS.value))
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    app.run(main)
