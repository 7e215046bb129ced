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

from prism_jax.evaluation import paired_difference
from prism_jax.evaluation.summary import scores_of
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
        "change": change,
        "score": score,
        "percent": percent,
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
    factor = {"cd_l2": 1e4, "hd": 1e2, "f_score": 1.0}[metric]
    return f"{factor * scores_of(result, cloud)['mean'][metric]:.4g}"


def change(
    before: Mapping[str, Any], after: Mapping[str, Any], clouds: tuple[str, str]
) -> str:
    """How CD-L2 changes between two clouds, with its 95 % interval."""
    return percent(paired_difference(before, after, clouds=clouds))


def percent(found: Mapping[str, Any]) -> str:
    """A relative change and its interval."""
    low, high = (f"{100 * bound:+.1f}" for bound in found["interval"])
    return f"{100 * found['change']:+.1f} % [{low}, {high}]"


if __name__ == "__main__":
    main()
