"""The error for what a user can put right."""

import importlib
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any

StrPath = str | os.PathLike
Tell = Callable[[str], None]  # takes one line for the user


def to_stderr(line: str) -> None:
    """Tells the user one line."""
    print(line, file=sys.stderr, flush=True)


class InputError(ValueError):
    """Input that cannot be used: one printable line with subject, fault and remedy. The
    subject is a file, a flag or an argument. The launchers print the line and end with
    exit status 2; a library caller catches it as a ``ValueError``."""

    def __init__(self, subject: StrPath, fault: str, remedy: str):
        fault = fault[:1000]  # it may quote megabytes of a file
        line = f"{os.fspath(subject)}: {fault}; {remedy}"
        printable = "".join(c if c.isprintable() else " " for c in line)
        super().__init__(" ".join(printable.split()))
        self.fault, self._parts = fault, (os.fspath(subject), fault, remedy)

    def __reduce__(self):
        """From a process of a pool to the one that waits for it."""
        return type(self), self._parts


def unreadable(path: StrPath, error: Exception) -> InputError:
    """The InputError for what the system says of reading a path."""
    fault = f"cannot be read ({getattr(error, 'strerror', None) or error})"
    return InputError(path, fault, "check the path and its permissions")


def unwritable(path: StrPath, error: Exception) -> InputError:
    """The InputError for what the system says of writing a file."""
    fault = f"cannot be written ({getattr(error, 'strerror', None) or error})"
    return InputError(path, fault, "choose another path, or free some space")


def choose(flag: str, value: str, choices: Iterable[str]) -> str:
    """`value` if it is one of the choices; else raises InputError about the flag."""
    choices = tuple(choices)
    if value not in choices:
        remedy = f"use {'one of ' if len(choices) > 1 else ''}{', '.join(choices)}"
        raise InputError(flag, f"unknown value {value!r}", remedy)
    return value


def require(package: str, extra: str) -> Any:
    """The imported package of an optional extra; InputError where it is missing. Called
    where the package is used, so that nothing else needs it."""
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package.split(".")[0]:
            raise
        remedy = f'install the extra: pip install "prism_jax[{extra}]"'
        raise InputError(package, "not installed", remedy) from None
