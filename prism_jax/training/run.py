"""A run directory: the resolved configuration, the metrics log, the progress bar."""

import contextlib
import json
import pathlib
import subprocess
import time
from collections.abc import Iterator
from typing import Any

from tqdm import tqdm

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
    folder = make_output_dir(pathlib.Path(workdir))
    path = folder / "config.json"
    resolved = json.loads(json.dumps({"config": config, "seed": seed}))
    if not path.exists():
        text = json.dumps({**resolved, "commit": commit()}, indent=2)
        write_bytes(path, text.encode())
    elif not resume:
        remedy = "resume it with --resume, or choose another --workdir"
        raise InputError(str(folder), "this folder already holds a run", remedy)
    else:
        before = json.loads(path.read_text())
        changes = [*_changes({key: before.get(key) for key in resolved}, resolved)]
        if changes:
            shown, others = changes[:_SHOWN], len(changes) - _SHOWN
            shown += [f"and {others} more"] if others > 0 else []
            fault = f"configuration differs from the run's: {', '.join(shown)}"
            remedy = "resume with the settings and data of its config.json"
            raise InputError(str(folder), fault, remedy)
    remove_unfinished(folder)
    return folder


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
    """The commit of the working copy that this package runs from, with ``-dirty`` if
    its files are not the commit's, but for docs, where results are written; None if it
    runs from none."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments],
            cwd=pathlib.Path(__file__).parents[1],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    try:
        # An installed package may lie in a working copy of something else.
        git("ls-files", "--error-unmatch", "__init__.py")
        others = ("--", ":(top)", ":(top,exclude)docs")
        changed = git("status", "--porcelain", "--untracked-files=no", *others)
        return git("rev-parse", "HEAD") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


class Log:
    """One JSON object a line in ``metrics.jsonl``, and a progress bar on stderr. Lines
    that a run wrote after the step that it goes on from are dropped."""

    def __init__(
        self, folder: pathlib.Path, name: str, total: int, step: int, batch_size: int
    ):
        path = folder / "metrics.jsonl"
        if path.exists():
            _drop_after(path, name, step)
        self._file = path.open("a")
        self._name = name
        self._start, self._waited = time.monotonic(), 0.0
        done, shown = step * batch_size, {"unit": "sample", "mininterval": 2.0}
        self._bar = tqdm(total=total, initial=done, desc=name, **shown)

    def advance(self, samples: int) -> None:
        """Moves the bar."""
        self._bar.update(samples)

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Counts what is done inside as waiting for data."""
        start = time.monotonic()
        yield
        self._waited += time.monotonic() - start

    def show(self, **values: float) -> None:
        """Shows values beside the bar, and the share of the time spent waiting."""
        values["data_wait"] = self._waited / self._seconds()
        text = {key: f"{value:.4g}" for key, value in values.items()}
        self._bar.set_postfix(text, refresh=False)

    def write(self, step: int, **values: dict[str, float]) -> None:
        """Adds a line."""
        seconds = self._seconds()
        rate = (self._bar.n - self._bar.initial) / seconds
        line = {"phase": self._name, "step": step, "samples": self._bar.n}
        line |= {"samples_per_second": round(rate, 2)}
        line |= {"data_wait": round(self._waited / seconds, 4), **values}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    def _seconds(self) -> float:
        return max(time.monotonic() - self._start, 1e-9)

    def close(self) -> None:
        """Ends the bar and the file."""
        self._bar.close()
        self._file.close()


def _drop_after(path: pathlib.Path, name: str, step: int) -> None:
    """Leaves the phase's lines up to this step, those of others, and no broken one."""
    kept = []
    for text in path.read_text().splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if line["phase"] != name or line["step"] <= step:
            kept.append(text + "\n")
    write_bytes(path, "".join(kept).encode())
