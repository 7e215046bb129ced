"""Commands run within the tests' own process."""

import contextlib
import importlib
import signal
import sys
from collections.abc import Iterator
from types import ModuleType

import grain  # noqa: F401  (defines flags of its own when it is first imported)
import jax
import pytest
from absl import app, flags

INSTALLED = ("complete", "stream", "envelope")
"""What `prism-complete` and the other installed commands are called in `parse`."""


class _Parsed(Exception):
    """Ends a launcher once its flags are read."""


@contextlib.contextmanager
def _as_command(*argv: str) -> Iterator[pytest.MonkeyPatch]:
    """A process defines its flags once; these tests do so again and again."""
    known = set(flags.FLAGS)
    # It may be ignored, as in the background of a shell.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [*argv])
        try:
            yield patch
        finally:
            signal.signal(signal.SIGINT, before)
            jax.config.update("jax_disable_most_optimizations", False)
            for name in set(flags.FLAGS) - known:
                delattr(flags.FLAGS, name)


def run(command: ModuleType, *arguments: str) -> int:
    """The launcher's exit status with these arguments."""
    app.define_help_flags()
    with _as_command(command.__name__, *arguments), pytest.raises(SystemExit) as ended:
        command.run()
    return ended.value.code or 0


def parse(launcher: str, *arguments: str) -> None:
    """Reads a launcher's arguments and leaves it; absl's error if it has no such."""
    package = "prism_jax.cli" if launcher in INSTALLED else "experiments"
    command = importlib.import_module(f"{package}.{launcher}")

    def read(*_, **__):
        flags.FLAGS(sys.argv)
        raise _Parsed

    with _as_command(launcher, *arguments) as patch, pytest.raises(_Parsed):
        patch.setattr(command, "launch", read, raising=False)
        patch.setattr(app, "run", read)
        command.run()
