"""Draws the rooms of prism_jax into docs/design.md, from what the code imports.

python -m experiments.rooms
"""

import ast
import pathlib
import re

from prism_jax.io.atomic import write_bytes

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "prism_jax"
PAGE = ROOT / "docs" / "design.md"
SHOWN = re.compile(
    r"(<!-- (\w+): python -m experiments\.rooms -->\n).*?(<!-- end -->)", re.DOTALL
)
APART = ("assets", "traced")
"""Files that ship, and a cache on disk: no rooms to walk through."""


def main() -> None:
    """Writes the page."""
    write_bytes(PAGE, page().encode())


def page() -> str:
    """docs/design.md with its picture and its table of rooms drawn anew."""
    parts = {"picture": picture(), "rooms": table()}
    return SHOWN.sub(lambda m: f"{m[1]}{parts[m[2]]}\n{m[3]}", PAGE.read_text())


def rooms() -> dict[str, list[pathlib.Path]]:
    """The files of each room: a folder or a file of the package."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if name != "__init__" and name not in APART:
            found.setdefault(name, []).append(path)
    return found


def picture() -> str:
    """A Mermaid diagram: an arrow from each room to those that it imports, but none to
    what it reaches through another room anyway."""
    below = {name: imported(files) - {name} for name, files in rooms().items()}
    reached = {name: reach(name, below) for name in below}
    lines = ["```mermaid", "flowchart TD", *(f"    {name}" for name in below)]
    for name, targets in below.items():
        apart = [target for target in targets if name not in reached[target]]
        through = set().union(*(reached[target] for target in apart))
        lines += [f"    {name} --> {target}" for target in sorted(targets - through)]
    return "\n".join([*lines, "```"])


def table() -> str:
    """Each room, and what its docstring says that it is."""
    rows = ["| room | what it is |", "| --- | --- |"]
    for name in rooms():
        head = PACKAGE / name / "__init__.py"
        head = head if head.exists() else head.parent.with_suffix(".py")
        words = (ast.get_docstring(ast.parse(head.read_text())) or "").split("\n\n")[0]
        rows.append(f"| `{name}` | {' '.join(words.split())} |")
    return "\n".join(rows)


def imported(files: list[pathlib.Path]) -> set[str]:
    """The rooms that these files import, wherever in a file the import stands."""
    found = set()
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "prism_jax":
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                package, *rest = node.module.split(".")
                found |= set(rest[:1]) if package == "prism_jax" else set()
    return found & set(rooms())


def reach(name: str, below: dict[str, set[str]]) -> set[str]:
    """All rooms that one imports, through others too."""
    found, waiting = set(), [name]
    while waiting:
        new = below[waiting.pop()] - found
        found |= new
        waiting += new
    return found


if __name__ == "__main__":
    main()
