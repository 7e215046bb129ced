"""What an installation without extras needs, and what is in the wheel."""

import ast
import importlib.metadata
import json
import pathlib
import re
import subprocess
import sys
import tomllib
import zlib

ROOT = pathlib.Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
UNTESTED = {"test", "cuda12", "cuda13", "torch", "ouster"}
"""Extras that are large, or pin others' versions: tests that want them skip."""

CORE = """
import json, sys
NAMES, ARGUMENTS = json.loads(sys.argv[1])

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import prism_jax
from prism_jax import Completer, load_pretrained, make_adapt
from prism_jax.cli import complete

sys.argv[1:] = ARGUMENTS
try:
    complete.run()
finally:
    ours = [name for name in sys.modules if name.split(".")[0] == "prism_jax"]
    print(json.dumps([sys.modules[name].__file__ for name in ours]))
"""
WITHOUT_EXTRA = """
import runpy, sys
sys.modules[sys.argv[1]] = None
sys.argv = sys.argv[2:]
runpy.run_module(f"experiments.{sys.argv[0]}", run_name="__main__")
"""


def distributions(requirements) -> set[str]:
    names = {re.split(r"[\[<>=]", requirement)[0] for requirement in requirements}
    return {name.lower() for name in names} - {"prism_jax"}


def imported(path: str) -> set[str]:
    """Top-level modules that a file imports, wherever the import stands."""
    found = set()
    for node in ast.walk(ast.parse(pathlib.Path(path).read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module).split(".")[0])
    return found - {"prism_jax"} - sys.stdlib_module_names


def modules_of(requirements) -> list[str]:
    """Top-level modules of the packages."""
    wanted = distributions(requirements)
    return [
        module
        for module, owners in importlib.metadata.packages_distributions().items()
        if wanted & {owner.lower() for owner in owners}
    ]


def test_without_any_extra():
    """Cards are shown, and what is needed is what is declared."""
    extras = {name for names in EXTRAS.values() for name in names}
    given = (
        modules_of(extras - {"jax[cuda12]", "jax[cuda13]"}),
        ["--weights=small", "--card"],
    )
    command = [sys.executable, "-c", CORE, json.dumps(given)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    printed, _, loaded = ended.stdout.strip().rpartition("\n")
    assert printed.startswith("# small\n")
    files = json.loads(loaded)
    assert len(files) > 40
    owners = importlib.metadata.packages_distributions()
    needed = {owners[module][0].lower() for path in files for module in imported(path)}
    # jax.export reads and writes its files with flatbuffers; evaluation tells of its
    # progress with tqdm.
    declared = distributions(PROJECT["dependencies"])
    assert needed | {"flatbuffers", "tqdm"} == declared
    assert len(declared) <= 14


def test_a_missing_extra_is_one_line():
    program = [sys.executable, "-c", WITHOUT_EXTRA, "optax", "train"]
    ended = subprocess.run(program, cwd=ROOT, capture_output=True, text=True)
    told = 'optax: not installed; install the extra: pip install "prism_jax[train]"'
    assert ended.stderr == f"train: {told}\n"
    assert ended.returncode != 0


def test_all_that_tests_need_is_in_one_extra():
    (ours,) = [name for name in EXTRAS["test"] if name.startswith("prism_jax[")]
    assert set(ours[10:-1].split(",")) == set(EXTRAS) - UNTESTED


def test_the_wheel_is_at_most_8_megabytes():
    files = [path for path in (ROOT / "prism_jax").rglob("*") if path.is_file()]
    files = [path for path in files if "__pycache__" not in path.parts]
    assert sum(len(zlib.compress(path.read_bytes(), 6)) for path in files) < 8e6
