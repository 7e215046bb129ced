"""Commands run within the tests' own process."""

import importlib
import sys
from types import ModuleType

import grain  # noqa: F401  (defines flags of its own when it is first imported)
import pytest
from absl import app, flags


def run(command: ModuleType, *arguments: str) -> int:
    """The launcher's exit status with these arguments."""
    app.define_help_flags()
    known = set(flags.FLAGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [command.__name__, *arguments])
        try:
            with pytest.raises(SystemExit) as ended:
                command.run()
        finally:
            # A process defines its flags once; these tests do so again and again.
            for name in set(flags.FLAGS) - known:
                delattr(flags.FLAGS, name)
    return ended.value.code or 0


INSTALLED = ("complete", "stream", "envelope")
"""What `prism-complete` and the other installed commands are called in `parse`."""


class _Parsed(Exception):
    """Ends a launcher once its flags are read."""


def parse(launcher: str, *arguments: str) -> None:
    """Reads a launcher's arguments and leaves it; absl's error if it has no such."""
    package = "prism_jax.cli" if launcher in INSTALLED else "experiments"
    command = importlib.import_module(f"{package}.{launcher}")
    known = set(flags.FLAGS)

    def read(*_, **__):
        flags.FLAGS(sys.argv)
        raise _Parsed

    with pytest.MonkeyPatch.context() as patch, pytest.raises(_Parsed):
        patch.setattr(sys, "argv", [launcher, *arguments])
        patch.setattr(command, "launch", read, raising=False)
        patch.setattr(app, "run", read)
        try:
            command.run()
        finally:
            for name in set(flags.FLAGS) - known:
                delattr(flags.FLAGS, name)
