"""A run's metrics log and its progress bar."""

import json
import pathlib
import time

from tqdm import tqdm

from prism_jax.io.atomic import write_bytes


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
        self._start = time.monotonic()
        done, shown = step * batch_size, {"unit": "sample", "mininterval": 2.0}
        self._bar = tqdm(total=total, initial=done, desc=name, **shown)

    def advance(self, samples: int) -> None:
        """Moves the bar."""
        self._bar.update(samples)

    def write(self, step: int, **values: dict[str, float]) -> None:
        """Adds a line, and shows the last of its losses beside the bar."""
        for name, loss in [*values.get("losses", {}).items()][-1:]:
            self._bar.set_postfix({name: f"{loss:.4g}"}, refresh=False)
        seconds = max(time.monotonic() - self._start, 1e-9)
        rate = (self._bar.n - self._bar.initial) / seconds
        line = {"phase": self._name, "step": step, "samples": self._bar.n}
        line |= {"samples_per_second": round(rate, 2), **values}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

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
