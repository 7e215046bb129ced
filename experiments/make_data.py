"""Builds the procedural corpus: python -m experiments.make_data --split=all"""

import dataclasses
from typing import Any

from absl import app, flags

from experiments.launch import launch
from prism_jax.data.corpus import SPLITS, CorpusConfig, build_corpus

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher; sizes are fields of CorpusConfig."""
    flags.DEFINE_enum("split", "all", [*SPLITS, "all"], "Split to build.")
    flags.DEFINE_string("cache_dir", None, "By default the user's cache folder.")
    flags.DEFINE_integer("num_workers", None, "By default one for every core.", 0)
    for name, default in dataclasses.asdict(CorpusConfig()).items():
        flags.DEFINE_integer(name, default, f"CorpusConfig.{name}")


def main(argv):
    """Builds the splits that are asked for and prints their folders."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument {argv[1]!r}")
    names = [field.name for field in dataclasses.fields(CorpusConfig)]
    sizes: dict[str, Any] = {name: FLAGS[name].value for name in names}
    config = CorpusConfig(**sizes)
    for split in SPLITS if FLAGS.split == "all" else [FLAGS.split]:
        print(build_corpus(split, config, FLAGS.cache_dir, FLAGS.num_workers))


def run():
    """The entry point."""
    define_flags()
    launch("make_data", main)


if __name__ == "__main__":
    run()
