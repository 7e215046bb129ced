"""README and docs: their Python examples run, their figures are those of the tables."""

import importlib
import importlib.util
import json
import pathlib
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments import results
from experiments.assets import CELLS
from experiments.calibrate import unfitted
from experiments.coverage import coverage_markdown
from prism_jax.assets import asset
from prism_jax.completion.weights import save_weights
from prism_jax.evaluation.metrics import score
from prism_jax.io.ply import read_ply

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = {page.name: page for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]}
EXAMPLES = {
    name: re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    for name, page in PAGES.items()
}
FILES = (".bt", ".json", ".jsonl", ".html", ".npz", ".ply", ".stl")
GIVEN = """
import numpy as np
points = np.load("scan.npy")
sensor_position = np.array([0.0, 0.0, 0.0], np.float32)
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


@pytest.fixture
def run(folder, monkeypatch, capsys):
    """``run(code)``: what the code prints, in a folder with a scan and weights."""
    monkeypatch.chdir(folder)

    def run(code: str) -> str:
        exec(code.replace('"small"', '"weights.safetensors"'), {})
        return capsys.readouterr().out

    return run


def test_a_plain_script(run, folder):
    found = {name: len(codes) for name, codes in EXAMPLES.items() if codes}
    assert found == {"README.md": 1, "python.md": 2, "data.md": 1}, "and no others"
    trust, error = run(EXAMPLES["README.md"][0]).split()
    assert trust in ("high", "fair", "low") and float(error) > 0
    completed, scan = np.load(folder / "completed.npy"), np.load(folder / "scan.npy")
    np.testing.assert_array_equal(completed[: len(scan)], scan)


@pytest.mark.slow
def test_a_turned_scan_inside_ones_own_jax_code(tmp_path, monkeypatch):
    """With the weights that users have."""
    monkeypatch.chdir(tmp_path)
    turn = Rotation.from_euler("z", 135, degrees=True)
    points = turn.apply(read_ply(asset("sample.ply"))).astype(np.float32)
    np.save("scan.npy", points)
    given = GIVEN.replace("[0.0, 0.0, 0.0]", "[2.5, 0.0, 1.5]")
    exec(given + EXAMPLES["python.md"][0] + 'np.save("done.npy", completed)', {})
    # 0.025 of the scan's; 2.2 of it in the heading that it comes in.
    truth = turn.apply(read_ply(asset("sample_complete.ply")))
    done = score(np.load("done.npy"), truth)
    assert done.cd_l2 < 0.05 * score(points, truth).cd_l2


@pytest.mark.slow
def test_a_scene(run, folder):
    """A box on a table, seen from above."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-3, 3, (4000, 3)) * [1, 1, 1e-3]
    box = rng.uniform(-0.5, 0.5, (600, 3)) + [0, 0, 0.5]
    box[:, 2] = np.where(rng.random(600) < 0.5, 1.0, box[:, 2])
    points = np.concatenate([table, box]) - [0, 0, 8]
    np.save(folder / "scan.npy", points.astype(np.float32))
    printed = run(GIVEN + EXAMPLES["python.md"][1] + "print(len(table))")
    first, last = printed.split("\n")[0], printed.split()[-1]
    assert first.startswith("0 ") and "measured" in first and "added" in first
    assert 3900 < int(last) < 4100


def test_ones_own_recordings(run, folder):
    (folder / "my_cells").symlink_to(CELLS)
    shown = "\nprint(len(frames), frames[0].partial.shape[1])\n"
    assert run(EXAMPLES["data.md"][0] + shown).split() == ["12", "3"]


def test_pages_are_what_the_results_give():
    for path, text in results.pages().items():
        assert path.read_text() == text, "run python -m experiments.results"


def stored(name: str) -> dict:
    """What a command wrote."""
    return json.loads((results.TABLES / f"{name}.json").read_text())


def cells(page: str, after: str, start: str) -> list[str]:
    """The cells of the first row that starts so, after these words of a page."""
    _, text = PAGES[page].read_text().split(after, 1)
    row = next(line for line in text.splitlines() if line.startswith(f"| {start} "))
    return [cell.strip() for cell in row.strip("|").split("|")]


@pytest.mark.parametrize("page", ["README.md", "results.md"])
def test_what_a_user_gets_is_what_was_scored(page):
    for start, name in [
        ("new shapes, trained", "test"),
        ("new shapes, unseen", "unseen"),
        ("robot cells, unseen", "robots"),
    ]:
        # Not of weights.json, which the page shows, but of the same views.
        clouds = stored(name)["clouds"]
        before, after = (
            1e4 * clouds[cloud]["mean"]["cd_l2"]
            for cloud in ("partial", "completed_unadapted")
        )
        shown = [f"{before:.4g}", f"{after:.4g}", f"{before / after:.2g}"]
        assert cells(page, "| scored on |", start)[1:4] == shown
    told = stored("background")["sets"]["objects-test"]["rows"]["empty"]["mean"]
    shown = cells(page, "| scored on |", "artist-made models")
    assert shown[4] == f"{1e4 * told['cd_l2']:.4g}"


def test_coverage_of_envelopes_is_what_was_measured():
    page = PAGES["envelope.md"].read_text()
    rows = coverage_markdown(stored("coverage")).splitlines()
    fixed = [row.replace(" fixed |", "") for row in rows if " fixed |" in row]
    assert len(fixed) == 12 and all(row in page for row in fixed)


def test_figures_stand_where_they_belong():
    """One of each table, as the JSON has it."""
    row = stored("table_1_objects")["rows"]["CRA-PCN"]
    low, high = row["intervals"]["cd_l1"]
    shown = f"{1e3 * row['mean']['cd_l1']:.4g} [{1e3 * low:.4g}, {1e3 * high:.4g}]"
    assert cells("results.md", "Artist-made models,", "CRA-PCN")[2] == shown
    found = stored("table_2")["rows"]["meta-trained, K = 10"]["change"]["cd_l2"]
    shown = cells("results.md", "**Table II:", "meta-trained, K = 10")[4]
    assert shown == in_per_cent(found)
    for name, label in [("objects", "artist-made models"), ("robots", "robot cells")]:
        row = cells("results.md", "Nobody has the true gradient", label)
        ours = "told, adapted by the new objective, removed"
        found = stored(f"adaptation_{name}")["rows"][ours]["change"]["cd_l2"]
        assert row[3] == in_per_cent(found)
        assert in_per_cent(found) in PAGES["README.md"].read_text().replace("\n", " ")
    found = stored("trust")["trust"]["crop"]["worst_tenth_low"]
    shown = cells("results.md", "**Confidence.**", "crop (369)")[4]
    assert shown == f"{100 * found:.0f} %"
    found = stored("point_errors")["sigma"]["all"]["below_two"]
    assert cells("results.md", "**Sigma.**", "all sets")[4] == f"{100 * found:.0f} %"
    rows = {row["name"]: row for row in stored("speed")["rows"]}
    late = rows["prism-complete, first run"]
    shown = cells("results.md", "## Speed", "startup | prism-complete, first run")
    assert shown[2] == f"{late['ours']} s, {late['peak_mib']:.0f} MiB"
    first = PAGES["README.md"].read_text().split("\n## ")[0]
    assert "<!-- gain: python -m experiments.results -->\n**Adaptation" in first


def in_per_cent(found: dict) -> str:
    """A change and its interval."""
    change, low, high = (100 * x for x in (found["change"], *found["interval"]))
    return f"{change:+.1f} % [{low:+.1f}, {high:+.1f}]"


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
    """`room.module.name`, `path/to/file`, and `room/file.py`: `name`."""
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
    for path, names in re.findall(
        rf"`((?:{rooms})/[\w/]+\.py)`(?::((?: `[\w.]+`)*))?", text
    ):
        code = ROOT / "prism_jax" / path
        assert code.exists(), f"{name} speaks of {path}"
        for said in re.findall(r"`(?:\w+\.)?(\w+)`", names):
            assert re.search(rf"^ *(?:def |class )?{said}\b", code.read_text(), re.M), (
                f"{name} finds {said} in {path}"
            )
