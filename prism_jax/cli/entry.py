"""The installed commands, which Ctrl-C ends in one line from the first moment on."""

import contextlib
import functools
import importlib
import os
import signal
import sys
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
    status = 0
    try:
        importlib.import_module(f"prism_jax.cli.{name}").run()
    except SystemExit as ended:
        status = ended.code
    # All is written by now: taking Python and XLA down by the usual way takes a quarter
    # of a second, waits for threads, and can crash.
    from prism_jax.io.files import remove_temporary_cache

    remove_temporary_cache()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):
            stream.flush()
    os._exit(int(status or 0))


# `prism-complete`, `prism-stream` and `prism-envelope`.
complete = functools.partial(_start, "complete")
stream = functools.partial(_start, "stream")
envelope = functools.partial(_start, "envelope")
