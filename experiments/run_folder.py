"""A run's folder: its resolved configuration, its seed and its commit."""

import json
import pathlib
import subprocess
from collections.abc import Iterator
from typing import Any

from prism_jax.io.atomic import make_output_dir, remove_unfinished, write_bytes
from prism_jax.io.errors import InputError

_SHOWN = 3


def open_run(
    workdir: str, config: dict[str, Any], seed: int, resume: bool
) -> pathlib.Path:
    """The run's folder, with config, seed and commit written to ``config.json``.

    A folder that holds a run already is refused unless ``resume`` is set, and then only
    the same configuration and seed may go on in it.
    """
    check_run(workdir, config, seed, resume)
    folder = make_output_dir(pathlib.Path(workdir))
    path = folder / "config.json"
    if not path.exists():
        about = {"config": config, "seed": seed, "commit": commit()}
        write_bytes(path, json.dumps(about, indent=2).encode())
    remove_unfinished(folder)
    return folder


def check_run(workdir: str, config: dict[str, Any], seed: int, resume: bool) -> None:
    """InputError if a run in this folder may not go on with this seed and these parts
    of a configuration; nothing if there is no run."""
    path = pathlib.Path(workdir) / "config.json"
    if not path.exists():
        return
    if not resume:
        remedy = "resume it with --resume, or choose another --workdir"
        raise InputError(workdir, "this folder already holds a run", remedy)
    before = json.loads(path.read_text())
    held = {key: before["config"].get(key) for key in config}
    now = json.loads(json.dumps({"config": config, "seed": seed}))
    changes = [*_changes({"config": held, "seed": before["seed"]}, now)]
    if changes:
        shown, others = changes[:_SHOWN], len(changes) - _SHOWN
        shown += [f"and {others} more"] if others > 0 else []
        fault = f"configuration differs from the run's: {', '.join(shown)}"
        remedy = "resume with the settings and data of its config.json"
        raise InputError(workdir, fault, remedy)


def _changes(before: Any, now: Any, path: str = "") -> Iterator[str]:
    """What differs between two JSON values, by the way to it."""
    if isinstance(before, list) and isinstance(now, list):
        before, now = (dict(enumerate(values)) for values in (before, now))
    if isinstance(before, dict) and isinstance(now, dict):
        for key in [*before, *(key for key in now if key not in before)]:
            way = f"{path}.{key}" if path else str(key)
            yield from _changes(before.get(key), now.get(key), way)
    elif before != now:
        yield f"{path} is {before}, not {now}"


def started_from(folder: pathlib.Path) -> str | None:
    """The commit that a run was started from."""
    return json.loads((folder / "config.json").read_text())["commit"]


def commit() -> str | None:
    """The commit of the working copy, with ``-dirty`` if its files are not the
    commit's, but for docs, where results are written; None if there is none."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments],
            cwd=pathlib.Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    try:
        # This may lie in a working copy of something else.
        git("ls-files", "--error-unmatch", "__init__.py")
        others = ("--", ":(top)", ":(top,exclude)docs")
        changed = git("status", "--porcelain", "--untracked-files=no", *others)
        return git("rev-parse", "HEAD") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None
