"""Run directories and their log."""

import dataclasses
import json
import subprocess
import time

import pytest

from experiments.settings import resolve
from prism_jax.evaluation.tables import short
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.training import run
from prism_jax.training.run import Log, commit, open_run


def settings(*arguments):
    return dataclasses.asdict(resolve(*arguments))


PRESET = settings("tiny")


def test_a_new_folder_holds_the_resolved_configuration(tmp_path):
    folder = open_run(str(tmp_path / "deep" / "run"), PRESET, 7, resume=False)
    written = json.loads((folder / "config.json").read_text())
    assert written["seed"] == 7
    assert written["commit"] == commit()
    plain = json.loads(json.dumps(PRESET))
    assert written["config"] == plain
    assert plain["model"]["backbone"]["num_points"] == 64


def test_a_used_folder_needs_resume(tmp_path):
    workdir = str(tmp_path / "run")
    open_run(workdir, PRESET, 0, resume=False)
    before = (tmp_path / "run" / "config.json").read_bytes()
    with pytest.raises(InputError, match="already holds a run; resume it with"):
        open_run(workdir, PRESET, 0, resume=False)
    assert open_run(workdir, PRESET, 0, resume=True) == tmp_path / "run"
    assert (tmp_path / "run" / "config.json").read_bytes() == before


@pytest.mark.parametrize(
    ("preset", "seed", "told"),
    [
        (PRESET, 1, "seed is 0, not 1"),
        (settings("small"), 0, "and [0-9]+ more"),
        (
            settings("tiny", ["model.margin=1.2"]),
            0,
            "config.model.margin is 1.4, not 1.2",
        ),
        (
            settings("tiny", ["pretrain.backbone.0.num_blocks=1"]),
            0,
            "config.pretrain.backbone.0.num_blocks is 0, not 1",
        ),
    ],
)
def test_another_configuration_does_not_go_on(tmp_path, preset, seed, told):
    open_run(str(tmp_path), PRESET, 0, resume=False)
    with pytest.raises(
        InputError, match=f"configuration differs from the run's: .*{told}"
    ):
        open_run(str(tmp_path), preset, seed, resume=True)


def test_resume_on_a_new_folder_starts_one(tmp_path):
    folder = open_run(str(tmp_path / "new"), PRESET, 0, resume=True)
    assert (folder / "config.json").exists()


@pytest.mark.parametrize("written", ["config.json", "metrics.jsonl"])
def test_going_on_removes_what_a_kill_left(tmp_path, monkeypatch, written):
    """A writer that is killed before it renames, and has no time to tidy up."""
    open_run(str(tmp_path), PRESET, 0, resume=False)
    (tmp_path / ".notes.tmp").touch()
    if written == "config.json":
        (tmp_path / written).unlink()
    with monkeypatch.context() as killed:
        killed.setattr("pathlib.Path.unlink", lambda *_, **__: None)
        killed.setattr("os.replace", _fail)
        with pytest.raises(KeyboardInterrupt):
            write_bytes(tmp_path / written, b"half")
    assert len([*tmp_path.glob(f".{written}.*.tmp")]) == 1
    open_run(str(tmp_path), PRESET, 0, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", ".notes.tmp"}


def _fail(*_):
    raise KeyboardInterrupt


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written to"):
        open_run(str(tmp_path / "file" / "run"), PRESET, 0, resume=False)


@pytest.fixture
def working_copy(tmp_path, monkeypatch):
    """A repository with this package in it, and git in it as a function."""
    module = tmp_path / "prism_jax" / "training" / "run.py"
    module.parent.mkdir(parents=True)
    for path in (module, tmp_path / "prism_jax" / "__init__.py"):
        path.write_text("")
    monkeypatch.setattr(run, "__file__", str(module))
    own = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]

    def git(*arguments):
        command = ["git", "-C", str(tmp_path), *own, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    git("init")
    return tmp_path, git


def test_the_commit_of_a_working_copy_and_whether_it_is_changed(working_copy):
    folder, git = working_copy
    table = folder / "docs" / "table.md"
    table.parent.mkdir()
    table.write_text("of before")
    git("add", ".")
    git("commit", "-m", "all")
    assert commit() == git("rev-parse", "HEAD")
    table.write_text("a result, which says of what commit it is")
    assert commit() == git("rev-parse", "HEAD")
    (folder / "notes").write_text("not of the repository")
    assert commit() == git("rev-parse", "HEAD")
    (folder / "prism_jax" / "training" / "run.py").write_text("changed")
    assert commit() == git("rev-parse", "HEAD") + "-dirty"
    assert short(commit()) == git("rev-parse", "HEAD")[:12] + "-dirty"


def test_the_commit_of_something_else_around_it_is_not_its_own(working_copy):
    _, git = working_copy
    git("commit", "--allow-empty", "-m", "of another project")
    assert commit() is None


def test_log_lines(tmp_path, capsys):
    log = Log(tmp_path, "seeds", total=64, step=2, batch_size=8)
    log.advance(8)
    log.show(loss=0.25)
    log.write(3, losses={"a": 0.5, "b": 0.25})
    log.write(3, validation={"c": 1.0})
    # Readable while the run goes on.
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    log.close()
    first, second = map(json.loads, lines)
    assert first["phase"] == "seeds"
    assert (first["step"], first["samples"]) == (3, 24)
    assert first["losses"] == {"a": 0.5, "b": 0.25}
    assert first["samples_per_second"] > 0
    assert second["validation"] == {"c": 1.0}
    assert "seeds" in capsys.readouterr().err


def test_time_spent_waiting_is_told_as_a_share_of_all(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    log = Log(tmp_path, "seeds", 8, step=0, batch_size=1)
    for waited, worked in [(1.0, 5.0), (2.0, 0.0)]:
        with log.waiting():
            now[0] += waited
        now[0] += worked
        log.write(1)
    log.close()
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    shares = [json.loads(line)["data_wait"] for line in lines]
    assert shares == pytest.approx([1 / 6, 3 / 8], abs=1e-4)


def test_a_second_log_goes_on_in_the_same_file(tmp_path):
    for name in ("seeds", "stages"):
        log = Log(tmp_path, name, 8, step=0, batch_size=1)
        log.write(1, losses={"a": 0.0})
        log.close()
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["phase"] for line in lines] == ["seeds", "stages"]


def test_going_on_drops_what_was_written_after_the_checkpoint(tmp_path):
    log = Log(tmp_path, "seeds", 8, step=0, batch_size=1)
    for step in (1, 2, 3):
        log.write(step, losses={"a": float(step)})
    log.close()
    path = tmp_path / "metrics.jsonl"
    other = json.dumps({"phase": "stages", "step": 9})
    path.write_text(path.read_text() + other + '\n{"phase": "seeds", "st')
    Log(tmp_path, "seeds", 8, step=2, batch_size=1).close()
    left = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(line["phase"], line["step"]) for line in left] == [
        ("seeds", 1),
        ("seeds", 2),
        ("stages", 9),
    ]
