"""The installed commands start here, outside the package, so that Ctrl-C ends them in
one line also while the package and JAX are being imported, which takes seconds."""

import atexit
import contextlib
import errno
import importlib
import os
import signal
import sys
import threading


def complete() -> None:
    """The command `prism-complete`."""
    _start("complete")


def stream() -> None:
    """The command `prism-stream`."""
    _start("stream")


def envelope() -> None:
    """The command `prism-envelope`."""
    _start("envelope")


def _start(command: str) -> None:
    """Runs it and ends the process. A stream, which has files to end, takes care of
    Ctrl-C itself."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    threading.Thread(target=_wait, args=(reader, command), daemon=True).start()
    _tell(writer)
    try:
        _run(command)
    except SystemExit as ended:
        if isinstance(ended.code, str):
            raise
        # Python takes half a second to end after JAX, and loses a Ctrl-C meanwhile.
        _tell(writer)
        atexit._run_exitfuncs()
        os._exit(ended.code or 0)


def _tell(writer: int) -> None:
    """Has Ctrl-C write there, unless the shell had it ignored."""
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        signal.signal(signal.SIGINT, lambda *_: None)


def _run(command: str) -> None:
    try:
        importlib.import_module(f"prism_jax.cli.{command}").run()
        sys.exit()
    except OSError as error:  # of files it is told as a user's mistake
        if error.filename or error.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        _end_unheard(command, error)
    finally:
        try:
            print(end="", flush=True)
        except OSError as error:
            _end_unheard(command, error)


def _wait(reader: int, command: str) -> None:
    """Ends the process after Ctrl-C, but not while it replaces files. An exception in
    the main thread would wait for a compilation to end, and one that comes in a
    callback, a finalizer or the start of an extension is dropped or aborts."""
    os.read(reader, 1)
    atomic = sys.modules.get("prism_jax.io.atomic")
    with getattr(atomic, "WRITING", contextlib.nullcontext()):
        with contextlib.suppress(OSError):
            os.write(2, f"prism-{command}: interrupted\n".encode())
        os._exit(130)


def _end_unheard(command: str, error: OSError) -> None:
    """Ends where nothing takes what is printed. A closed pipe asks for no line."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if error.errno != errno.EPIPE:
        line = f"standard output: cannot be written ({error.strerror})"
        print(f"prism-{command}: {line}", file=sys.stderr)
    sys.exit(1)
