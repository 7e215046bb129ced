"""README and docs: their Python examples run, their figures are those of the tables."""

import importlib
import importlib.util
import json
import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest

from experiments import results
from experiments.assets import CELLS
from experiments.calibrate import unfitted
from experiments.comparison import comparison_markdown
from experiments.plant import plant_markdown
from experiments.table_1 import table_markdown as table_1_markdown
from prism_jax.evaluation.tables import markdown
from prism_jax.weights import save_weights

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = {page.name: page for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]}
EXAMPLES = {
    name: re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    for name, page in PAGES.items()
}
FILES = (".json", ".jsonl", ".html", ".npz", ".ply", ".stl")
LONGEST = {"README.md": 150, "BUILD_NOTES.md": 250}
GIVEN = """
import numpy as np
points = np.load("scan.npy")
sensor_position = np.array([0.0, 0.0, 0.0], np.float32)
"""
SHOWN = """
np.save("metres.npy", metres)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, minimal, minimal_variables):
    folder = tmp_path_factory.mktemp("readme")
    width = minimal.model.backbone.global_features[-1]
    blank = unfitted(np.random.default_rng(0).normal(size=(30, width)))
    about = {"calibration": blank.to_dict()}
    path = folder / "weights.safetensors"
    save_weights(path, minimal.config.with_model(poses=3), minimal_variables, about)
    scan = np.random.default_rng(0).uniform([4, -1, -1], [5, 1, 1], (300, 3))
    np.save(folder / "scan.npy", scan.astype(np.float32))
    return folder


def run(folder, code: str) -> str:
    code = code.replace('"small"', '"weights.safetensors"')
    # A fresh process, as a user's: shapes are not checked there as under pytest.
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_every_example_is_run_here():
    found = {name: len(codes) for name, codes in EXAMPLES.items() if codes}
    assert found == {"README.md": 1, "python.md": 2, "data.md": 1}
    assert all('"small"' in EXAMPLES[n][0] for n in ("README.md", "python.md"))


def test_a_plain_script(folder):
    trust, error = run(folder, EXAMPLES["README.md"][0]).split()
    assert trust in ("high", "fair", "low") and float(error) > 0
    completed, scan = np.load(folder / "completed.npy"), np.load(folder / "scan.npy")
    np.testing.assert_array_equal(completed[: len(scan)], scan)


@pytest.mark.slow
def test_inside_ones_own_jax_code(folder, minimal):
    run(folder, GIVEN + EXAMPLES["python.md"][0] + SHOWN)
    metres, scan = np.load(folder / "metres.npy"), np.load(folder / "scan.npy")
    assert metres.shape == (3 * minimal.model.backbone.stage_sizes[-1], 3)
    assert np.isfinite(metres).all()
    # The unit cube is the box of the scan, its longest side times the margin.
    half = 0.5 * minimal.model.margin * np.ptp(scan, axis=0).max()
    middle = 0.5 * (scan.min(0) + scan.max(0))
    assert (np.abs(metres - middle) <= half * (1 + 1e-5)).all()


@pytest.mark.slow
def test_a_scene(folder):
    """A box on a table, seen from above."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-3, 3, (4000, 3)) * [1, 1, 1e-3]
    box = rng.uniform(-0.5, 0.5, (600, 3)) + [0, 0, 0.5]
    box[:, 2] = np.where(rng.random(600) < 0.5, 1.0, box[:, 2])
    points = np.concatenate([table, box]) - [0, 0, 8]
    np.save(folder / "scan.npy", points.astype(np.float32))
    printed = run(folder, GIVEN + EXAMPLES["python.md"][1] + "print(len(table))")
    first, last = printed.split("\n")[0], printed.split()[-1]
    assert first.startswith("0 ") and "measured" in first and "added" in first
    assert 3900 < int(last) < 4100


def test_ones_own_recordings(folder):
    (folder / "my_cells").symlink_to(CELLS)
    shown = "\nprint(len(frames), frames[0].partial.shape[1])\n"
    assert run(folder, EXAMPLES["data.md"][0] + shown).split() == ["20", "3"]


@pytest.mark.parametrize("path", results.tables(), ids=lambda path: path.stem)
def test_tables_are_those_of_their_results(path):
    """As the commands wrote them: JSON, Markdown, and what docs/results.md shows."""
    result = json.loads(path.read_text())
    kinds = {
        "passed": plant_markdown,
        "best_others": table_1_markdown,
        "rows": comparison_markdown,
    }
    text = next((kinds[key] for key in kinds if key in result), markdown)(result)
    assert path.with_suffix(".md").read_text() == text
    lines = [line for line in text.splitlines() if line]
    assert len(lines) > 4
    shown = PAGES["results.md"].read_text()
    assert not [line for line in lines if line not in shown]


def test_pages_show_the_tables():
    for path, text in results.pages().items():
        assert path.read_text() == text, "run python -m experiments.results"


def test_the_first_screen_says_what_adaptation_gains():
    first = PAGES["README.md"].read_text().split("\n## ")[0]
    assert "<!-- gain: python -m experiments.results -->\n**Adaptation" in first


@pytest.mark.parametrize("name", LONGEST)
def test_pages_stay_short(name):
    assert len(PAGES[name].read_text().splitlines()) <= LONGEST[name]


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    for file, anchor in re.findall(
        r"\]\(([^)#\s]*)#?([^)\s]*)\)", PAGES[name].read_text()
    ):
        if "://" in file:
            continue
        target = PAGES[name].parent / file if file else PAGES[name]
        assert target.exists(), f"{name} links to {file}"
        assert not anchor or anchor in anchors(target), f"{name}: {file}#{anchor}"


def anchors(page: pathlib.Path) -> set[str]:
    """What the headings of a page can be linked by."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    words = [re.sub(r"[^\w\- ]", "", head.lower()) for head in heads]
    return {"-".join(word.split(" ")) for word in words}


@pytest.mark.parametrize("name", PAGES)
def test_names_are_those_of_the_code(name):
    """`room.module.name` and `path/to/file`, as far as they are the repository's."""
    rooms = "|".join(path.stem for path in (ROOT / "prism_jax").iterdir())
    text = PAGES[name].read_text()
    for dotted in re.findall(rf"`(?:prism_jax\.)?((?:{rooms})\.[a-z_]\w*[\w.]*)", text):
        if dotted.endswith(FILES):
            continue
        module, _, attribute = f"prism_jax.{dotted}".rpartition(".")
        try:
            found = hasattr(importlib.import_module(module), attribute)
            found = found or importlib.util.find_spec(f"{module}.{attribute}")
        except ModuleNotFoundError:
            found = False
        assert found, f"{name} speaks of {dotted}"
    for path in re.findall(r"`((?:experiments|tests|prism_jax)/[\w./]*)`", text):
        assert (ROOT / path).exists(), f"{name} speaks of {path}"
