"""Makes the tables of docs/results.md again, by the commands that stand there.

python -m experiments.remake --output_dir=DIR [--tables=test,unseen] \
    [--given=CELLS=my_cells] [--given=scan_000.ply=my_scans/scan_000.ply]

Nothing in docs/tables changes, so what is made names a commit without changes. What is
in DIR already is not made again: the same command goes on where it was broken off, with
what is in DIR/unfinished. What a command leaves to its reader, such as where cells lie,
is to be given, or its table is left out.
"""

import pathlib
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence

from absl import flags

from experiments.results import ROOT
from prism_jax.cli.launch import SomeFailed, launch
from prism_jax.io.atomic import make_output_dir
from prism_jax.io.errors import InputError, choose

FLAGS = flags.FLAGS

_COMMAND = re.compile(
    r"python -m experiments\.\w+(?:[^`\n\\]|\\\n)*?"
    r"--output=docs/tables/(\w+)\.json(?:[^`\n\\]|\\\n)*"
)
_LEFT_OPEN = re.compile(r"\b[A-Z]{3,}\b")


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("output_dir", None, "Where the tables go.", required=True)
    flags.DEFINE_list("tables", [], "Which, by their names in docs/tables; or all.")
    flags.DEFINE_multi_string("given", [], "What stands for what, as CELLS=my_cells.")


def main() -> None:
    """Runs the commands one after the other, and names at the end what failed."""
    found = commands((ROOT / "docs" / "results.md").read_text())
    for name in FLAGS.tables:
        choose("table", name, found)
    given = {}
    for text in FLAGS.given:
        name, is_given, value = text.partition("=")
        if not is_given:
            raise InputError("--given", f"cannot read {text!r}", "write NAME=VALUE")
        given[name] = value
    folder = make_output_dir(pathlib.Path(FLAGS.output_dir))
    wanted = {name: found[name] for name in FLAGS.tables or found}
    if failed := remake(wanted, folder, given):
        raise SomeFailed([f"{name}: failed; its command says why" for name in failed])


def commands(page: str) -> dict[str, list[str]]:
    """The command of each table that a page of Markdown names, word by word."""
    return {
        match[1]: shlex.split(match[0].replace("\\\n", " "))
        for match in _COMMAND.finditer(page)
    }


def remake(
    found: Mapping[str, Sequence[str]],
    folder: pathlib.Path,
    given: Mapping[str, str],
    run: Callable[[Sequence[str]], int] = subprocess.call,
) -> list[str]:
    """Runs what has not left its table in a folder yet; returns what failed.

    What a command writes reaches the folder once it is done: some write as they go.
    """
    failed = []
    for name, words in found.items():
        values = [word.partition("=")[2] for word in words]
        left = [v for v in values if _LEFT_OPEN.search(v) and v not in given]
        if (folder / f"{name}.json").exists():
            print(f"{name}: is there")
        elif left:
            print(f"{name}: left out; give --given={left[0]}=...")
        else:
            own = make_output_dir(folder / "unfinished" / name)
            filled = [_filled(word, own, given) for word in words]
            command = [sys.executable, *filled[1:]]
            print(f"{name}: {shlex.join(command)}", flush=True)
            if run(command):
                failed.append(name)
                continue
            for path in own.iterdir():
                path.replace(folder / path.name)
    return failed


def _filled(word: str, folder: pathlib.Path, given: Mapping[str, str]) -> str:
    """With what is given in the place of what is left open, and what would be written
    to docs in the folder."""
    flag, is_flag, value = word.partition("=")
    if value.startswith("docs/"):
        return f"{flag}={folder / pathlib.Path(value).name}"
    return f"{flag}{is_flag}{given.get(value, value)}"


def run() -> None:
    """The entry point."""
    define_flags()
    launch("remake", main)


if __name__ == "__main__":
    run()
