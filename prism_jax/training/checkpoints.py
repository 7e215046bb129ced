"""Training states on disk, by Orbax: the latest, to resume, and the best, to keep."""

import math
import pathlib
from typing import Any

import jax
import orbax.checkpoint as ocp

from prism_jax.io.files import parsing

_KIND = "a sound checkpoint"
_REMEDY = "restore it from a backup, or delete the folder"


class Checkpoints:
    """Two Orbax managers over one run directory. A checkpoint appears whole or not at
    all; one that was damaged later raises InputError where it is read."""

    def __init__(self, workdir: pathlib.Path):
        root = workdir.absolute() / "checkpoints"
        self._latest = _manager(root / "latest")
        # Orbax keeps the metrics of a manager that ranks by them.
        self._best = _manager(root / "best", best_fn=lambda kept: -kept["score"])

    def save(self, step: int, state: Any, score: float | None = None) -> None:
        """Writes the state, first as the best, if its score is the lowest so far: a run
        that ends in between comes here again."""
        best, written = self.best_score(), ocp.args.StandardSave(state)
        if score is not None and score < (math.inf if best is None else best):
            self._best.save(step, args=written, metrics={"score": score})
            self._best.wait_until_finished()
        self._latest.save(step, args=written)
        self._latest.wait_until_finished()

    def best_score(self) -> float | None:
        """Score of the best checkpoint, or None before the first."""
        step = self.best_step()
        metrics = None if step is None else self._best.metrics(step)
        return None if metrics is None else float(metrics["score"])

    def best_step(self) -> int | None:
        """Step of the best checkpoint, or None before the first."""
        return self._best.latest_step()

    def restore(self, like: Any, best: bool = False) -> Any | None:
        """The latest state or the best, in the structure of ``like``; None if there is
        none."""
        manager = self._best if best else self._latest
        step = manager.latest_step()
        if step is None:
            return None
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        # Orbax raises errors of many kinds.
        with parsing(manager.directory, _KIND, _REMEDY, Exception):
            return manager.restore(step, args=ocp.args.StandardRestore(abstract))

    def close(self) -> None:
        """Waits for what is being written."""
        self._latest.close()
        self._best.close()


def _manager(folder: pathlib.Path, **options: Any) -> ocp.CheckpointManager:
    kept = ocp.CheckpointManagerOptions(max_to_keep=1, create=True, **options)
    with parsing(folder, _KIND, _REMEDY, Exception):
        return ocp.CheckpointManager(folder, options=kept)
