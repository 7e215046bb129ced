"""Folders of runs."""

import dataclasses
import json
import subprocess

import pytest

from experiments import run_folder
from experiments.run_folder import commit, open_run
from experiments.settings import resolve
from prism_jax.evaluation.tables import short
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError


def settings(*arguments):
    return dataclasses.asdict(resolve(*arguments))


PRESET = settings("tiny")


def test_a_folder_holds_one_run_and_its_configuration(tmp_path):
    folder = open_run(str(tmp_path / "deep" / "run"), PRESET, 7, resume=True)
    before = (folder / "config.json").read_bytes()
    written = json.loads(before)
    assert (written["seed"], written["commit"]) == (7, commit())
    assert written["config"] == json.loads(json.dumps(PRESET))
    with pytest.raises(InputError, match="already holds a run; resume it with"):
        open_run(str(folder), PRESET, 7, resume=False)
    assert open_run(str(folder), PRESET, 7, resume=True) == folder
    assert (folder / "config.json").read_bytes() == before


def test_another_configuration_does_not_go_on(tmp_path):
    open_run(str(tmp_path), PRESET, 0, resume=False)
    blocks = "pretrain.backbone.0.num_blocks"
    for preset, seed, change in (
        (PRESET, 1, "seed is 0, not 1"),
        (settings("small"), 0, "and [0-9]+ more"),
        (settings("tiny", [f"{blocks}=1"]), 0, f"config.{blocks} is 0, not 1"),
    ):
        fault = f"configuration differs from the run's: .*{change}"
        with pytest.raises(InputError, match=fault):
            open_run(str(tmp_path), preset, seed, resume=True)


def test_going_on_removes_what_a_kill_left(tmp_path, monkeypatch):
    """A writer that is killed before it renames, and has no time to tidy up."""

    def die(*_):
        raise KeyboardInterrupt

    open_run(str(tmp_path), PRESET, 0, resume=False)
    (tmp_path / ".notes.tmp").touch()
    with monkeypatch.context() as killed:
        killed.setattr("pathlib.Path.unlink", lambda *_, **__: None)
        killed.setattr("os.replace", die)
        with pytest.raises(KeyboardInterrupt):
            write_bytes(tmp_path / "metrics.jsonl", b"half")
    assert len([*tmp_path.glob(".metrics.*.tmp")]) == 1
    open_run(str(tmp_path), PRESET, 0, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", ".notes.tmp"}


def test_the_commit_of_a_working_copy_and_whether_it_is_changed(tmp_path, monkeypatch):
    """Not that of something else around the package; results are no change."""
    module = tmp_path / "experiments" / "run_folder.py"
    table = tmp_path / "docs" / "table.md"
    for path in (module, table, module.with_name("__init__.py")):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    monkeypatch.setattr(run_folder, "__file__", str(module))
    own = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]

    def git(*arguments):
        command = ["git", "-C", str(tmp_path), *own, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    git("init")
    git("commit", "--allow-empty", "-m", "of another project")
    assert commit() is None
    git("add", ".")
    git("commit", "-m", "all")
    head = git("rev-parse", "HEAD")
    table.write_text("a result, which says of what commit it is")
    (tmp_path / "notes").write_text("not of the repository")
    assert commit() == head
    module.write_text("changed")
    assert commit() == head + "-dirty"
    assert short(commit()) == head[:12] + "-dirty"
