"""Writes docs/results.md, and the figures of the README, from docs/tables.

python -m experiments.results

The words are those of experiments/results.md.jinja; every figure comes from a file in
docs/tables that another command wrote.
"""

import json
import pathlib
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import jinja2

from prism_jax.cli.launch import launch
from prism_jax.evaluation.tables import COLUMNS, percent, table_lines
from prism_jax.io.atomic import write_bytes

ROOT = pathlib.Path(__file__).resolve().parents[1]
TABLES = ROOT / "docs" / "tables"
WIDTH = 110
SHORT = ("cd_l2", "cd_l1", "f_score")
AS_IT_IS = ("#", "|", "![", "```", "<!--")
SHOWN = re.compile(
    r"(<!-- (\w+): python -m experiments\.results -->\n).*?(<!-- end -->)", re.DOTALL
)


def main() -> None:
    """Writes every page that shows figures."""
    for path, text in pages().items():
        write_bytes(path, text.encode())
        print(f"written {path.relative_to(ROOT)}")


def pages() -> dict[pathlib.Path, str]:
    """What each page says now: docs/results.md, and the README with its marked parts
    replaced by the template's blocks of the same name."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = environment.get_template("results.md.jinja")
    shown = {
        **{path.stem: json.loads(path.read_text()) for path in TABLES.glob("*.json")},
        "head": lambda *heads: "\n".join(table_lines(heads, [])),
        "scores": scores,
        "pair": pair,
        "change": lambda found: percent(found["change"], found["interval"]),
        "commit": lambda result: result["commit"][:7] + result["commit"][40:],
    }

    def block(match: re.Match) -> str:
        context = template.new_context(shown)
        text = "".join(template.blocks[match[2]](context))
        return match[1] + filled(text) + "\n" + match[3]

    readme = ROOT / "README.md"
    return {
        ROOT / "docs" / "results.md": filled(template.render(shown)) + "\n",
        readme: SHOWN.sub(block, readme.read_text()),
    }


def scores(row: Mapping[str, Any], metrics: Sequence[str] = SHORT) -> str:
    """Cells of a table: means in the units of `COLUMNS`, with their intervals."""
    cells = []
    factors = {column.metric: column.factor for column in COLUMNS}
    for metric in metrics:
        factor = factors[metric]
        digits = ".3f" if metric == "f_score" else ".4g"
        values = row["mean"][metric], *row["intervals"][metric]
        mean, low, high = (format(factor * value, digits) for value in values)
        cells.append(f"{mean} [{low}, {high}]")
    return " | ".join(cells)


def pair(result: Mapping[str, Any], row: str, against: str) -> Mapping[str, Any]:
    """How CD-L2 changes from one row of a comparison to another."""
    for found in result["pairs"]:
        if (found["row"], found["against"]) == (row, against):
            return found["change"]["cd_l2"]
    raise KeyError(f"{row} against {against}")


def filled(text: str) -> str:
    """The text with its paragraphs and lists filled to `WIDTH`."""
    parts = re.split(r"\n\s*\n", text.strip())
    return "\n\n".join(
        part if part.startswith(AS_IT_IS) else _fill(part) for part in parts
    )


def _fill(paragraph: str) -> str:
    items = re.split(r"\n(?=- )", paragraph)
    lines = textwrap.TextWrapper(
        WIDTH,
        subsequent_indent="  " if paragraph.startswith("- ") else "",
        break_long_words=False,
        break_on_hyphens=False,
    )
    # Code and intervals stay in one line.
    glued = [
        re.sub(r"`[^`]*`|\[[^]]*\]", lambda m: m[0].replace(" ", "\0"), item)
        for item in (" ".join(item.split()) for item in items)
    ]
    return "\n".join(lines.fill(item) for item in glued).replace("\0", " ")


if __name__ == "__main__":
    launch("results", main)
