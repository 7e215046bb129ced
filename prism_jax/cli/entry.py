"""The installed commands, which Ctrl-C ends in one line from the first moment on."""

import functools
import importlib
import os
import signal
from typing import Any


def _start(name: str) -> None:
    """Imports a command, which takes a second or more, and runs it. Until then nothing
    has been written, and packages that are half imported may swallow an exception or
    make another one of it: Ctrl-C leaves at once."""

    def leave(*_: Any) -> None:
        os.write(2, f"prism-{name}: interrupted\n".encode())
        os._exit(130)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, leave)
    command = importlib.import_module(f"prism_jax.cli.{name}")
    command.run()


# `prism-complete`, `prism-stream` and `prism-envelope`.
complete = functools.partial(_start, "complete")
stream = functools.partial(_start, "stream")
envelope = functools.partial(_start, "envelope")
