"""Limits on how much code and prose there is, and on how wide it is."""

import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
BUILT = {"build", "dist"}
APART = ("simulation", "baselines")
LINES = {
    "prism_jax": 20_000,
    "experiments": 6_500,
    "experiments/simulation": 13_000,
    "tests": 22_000,
}
BYTES = {
    "docs/results.md": 20_000,
    "docs/findings.md": 18_000,
    "docs/design.md": 5_000,
    "BUILD_NOTES.md": 14_000,
}
ALL_BYTES = 130_000
WIDTH, COLUMNS, CODE_WIDTH = 110, 8, 88


def files(folder: pathlib.Path, suffix: str) -> list[pathlib.Path]:
    """Those of the repository: none in hidden folders or in what a build leaves."""
    found = []
    for path in sorted(folder.rglob(f"*{suffix}")):
        parents = path.relative_to(ROOT).parts[:-1]
        if not any(part.startswith(".") or part in BUILT for part in parents):
            found.append(path)
    return found


CODE = files(ROOT, ".py")
PAGES = files(ROOT, ".md")


@pytest.mark.parametrize("folder", LINES)
def test_lines_of_code(folder):
    """Every line of a .py file counts, empty ones too."""
    place = ROOT / folder
    apart = [place / name for name in APART] if folder == "experiments" else []
    counted = [
        path
        for path in files(place, ".py")
        if not any(path.is_relative_to(other) for other in apart)
    ]
    assert counted
    lines = sum(len(path.read_text().splitlines()) for path in counted)
    assert lines <= LINES[folder]


def test_bytes_of_all_pages():
    assert sum(path.stat().st_size for path in PAGES) <= ALL_BYTES


@pytest.mark.parametrize("page", BYTES)
def test_bytes_of_a_page(page):
    assert (ROOT / page).stat().st_size <= BYTES[page]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_are_narrow(page):
    """Lines, but for images and rows of tables; and columns of tables."""
    for number, line in enumerate(page.read_text().splitlines(), 1):
        place = f"{page.name}:{number}"
        if line.lstrip().startswith("|"):
            columns = len(re.findall(r"(?<!\\)\|", line)) - 1
            assert columns <= COLUMNS, f"{place} has {columns} columns"
        elif not line.startswith("!["):
            assert len(line) <= WIDTH, f"{place} has {len(line)} characters"


def test_code_is_narrow():
    """As ruff counts, which leaves comments to checkers out."""
    for path in CODE:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            line = re.sub(r"\s*# (noqa|pyright: ignore).*", "", line)
            assert len(line) <= CODE_WIDTH, f"{path.relative_to(ROOT)}:{number}"
