"""The README's Python examples, run as they stand with a smaller network."""

import json
import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest

from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation import agreement_markdown, comparison_markdown, markdown
from prism_jax.weights import save_weights

README = pathlib.Path(__file__).resolve().parents[1] / "README.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
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
    save_weights(folder / "weights.safetensors", minimal.adapt, minimal_variables, {})
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


def test_there_are_three():
    assert len(EXAMPLES) == 3
    assert all('"small"' in code for code in EXAMPLES[:2])


def test_a_plain_script(folder):
    assert "run" in run(folder, EXAMPLES[0])
    completed, scan = np.load(folder / "completed.npy"), np.load(folder / "scan.npy")
    np.testing.assert_array_equal(completed[: len(scan)], scan)


def test_inside_ones_own_jax_code(folder, minimal):
    run(folder, GIVEN + EXAMPLES[1] + SHOWN)
    metres, scan = np.load(folder / "metres.npy"), np.load(folder / "scan.npy")
    assert metres.shape == (minimal.model.backbone.stage_sizes[-1], 3)
    assert np.isfinite(metres).all()
    # The unit cube is the box of the scan, its longest side times the margin.
    half = 0.5 * minimal.model.margin * np.ptp(scan, axis=0).max()
    middle = 0.5 * (scan.min(0) + scan.max(0))
    assert (np.abs(metres - middle) <= half * (1 + 1e-5)).all()


def test_ones_own_recordings(folder):
    (folder / "my_cells").symlink_to(RecordedCells.bundled().root)
    shown = "\nprint(len(frames), frames[0].partial.shape[1])\n"
    assert run(folder, EXAMPLES[2] + shown).split() == ["20", "3"]


TABLES = sorted((README.parent / "docs" / "tables").glob("*.json"))


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_tables_are_those_of_their_results(path):
    """As the commands wrote them: JSON, Markdown and what README or notes show."""
    result = json.loads(path.read_text())
    kinds = {"rows": comparison_markdown, "losses": agreement_markdown}
    (text,) = [make(result) for kind, make in kinds.items() if kind in result] or [
        markdown(result)
    ]
    assert path.with_suffix(".md").read_text() == text
    lines = [line for line in text.splitlines() if line]
    shown = README.read_text() + README.with_name("BUILD_NOTES.md").read_text()
    assert len(lines) > 4
    assert not [line for line in lines if line not in shown]


def test_there_are_tables():
    assert TABLES
