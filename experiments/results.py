"""Writes docs/results.md, and the figures of the README, from docs/tables.

python -m experiments.results

The words are those of experiments/results.md.jinja; every figure comes from a file in
docs/tables that another command wrote.
"""

import json
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import jinja2

from prism_jax.evaluation.tables import interval_text, percent
from prism_jax.io.atomic import write_bytes

ROOT = pathlib.Path(__file__).resolve().parents[1]
TABLES = ROOT / "docs" / "tables"
SHOWN = re.compile(
    r"(<!-- (\w+): python -m experiments\.results -->\n).*?(<!-- end -->)", re.DOTALL
)


def main() -> None:
    """Writes every page that shows figures."""
    for path, text in pages().items():
        write_bytes(path, text.encode())


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
    results = {path.stem: json.loads(path.read_text()) for path in tables()}
    shown = {
        **results,
        "table": table,
        "effect": effect,
        "pair": pair,
        "score": score,
        "change": lambda found: percent(found["change"], found["interval"]),
        "interval": interval_text,
        "carrier": lambda found: found["carried_by"]["category"],
        "without": without,
    }

    def block(match: re.Match) -> str:
        context = template.new_context(shown)
        return match[1] + "".join(template.blocks[match[2]](context)) + match[3]

    readme = ROOT / "README.md"
    return {
        ROOT / "docs" / "results.md": template.render(shown).strip() + "\n",
        readme: SHOWN.sub(block, readme.read_text()),
    }


def tables() -> list[pathlib.Path]:
    """The results that the pages are made from."""
    return sorted(TABLES.glob("*.json"))


def table(name: str) -> str:
    """The Markdown that was written beside a result."""
    return (TABLES / f"{name}.md").read_text().strip()


def score(result: Mapping[str, Any], cloud: str, metric: str = "cd_l2") -> str:
    """The mean of a cloud's scores, in the unit of the tables."""
    factor = {"cd_l2": 1e4, "hausdorff": 1e2, "f_score": 1.0}[metric]
    return f"{factor * result['clouds'][cloud]['mean'][metric]:.4g}"


def effect(result: Mapping[str, Any]) -> Mapping[str, Any]:
    """What adaptation changes in the CD-L2 of the network's own output."""
    return result["adaptation"]["network"]["cd_l2"]


def pair(
    result: Mapping[str, Any], row: str, against: str, measure: str = "cd_l2"
) -> Mapping[str, Any]:
    """What changes from one row of a comparison to another."""
    for found in result["pairs"]:
        if (found["row"], found["against"]) == (row, against):
            return found["change"][measure]
    raise KeyError(f"{row} against {against}")


def without(found: Mapping[str, Any]) -> str:
    """What is left of a change without the category that carries it."""
    rest = found["carried_by"]
    return percent(rest["change_without"], rest["interval_without"])


if __name__ == "__main__":
    main()
