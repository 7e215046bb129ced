"""What every command shares: a quiet log, and the user's mistakes in one line."""

import contextlib
import functools
import gc
import io
import math
import os
import pathlib
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from absl import app, flags, logging

from prism_jax.io.atomic import keep
from prism_jax.io.errors import InputError, unreadable, unwritable
from prism_jax.io.files import default_cache_dir

FLAGS = flags.FLAGS
PATIENCE = 2.0  # seconds after which a step says what it is doing


def launch(name: str, main: Callable[..., None], takes_words: bool = False) -> None:
    """Runs `main` under absl. An `InputError` or a fault in the flags ends in one line
    on stderr and status 2, Ctrl-C in one line and status 130. `main` gets the words
    that are no flags if it takes them."""

    def with_words(argv: Sequence[str]) -> None:
        for flag in FLAGS:
            value = FLAGS[flag].value
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"--{flag}", f"not finite: {value}", "give a number")
            if flag.startswith("output") and value == "":
                raise InputError(f"--{flag}", "empty", "name a file or folder")
        if takes_words:
            given = (FLAGS[n].value for n in FLAGS if not n.startswith("output"))
            files = (v for v in given if isinstance(v, str) and os.path.isfile(v))
            keep([*argv[1:], *files])
        elif len(argv) > 1:
            raise InputError(argv[1], "not a flag", "write flags as --name=value")
        main(argv[1:]) if takes_words else main()
        sys.stdout.flush()

    if sys.stderr is None:
        sys.stderr = io.StringIO()  # progress bars want one
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A folder's name may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    # --help is that of the program that was started, and that may be a wrapper.
    sys.modules["__main__"].__doc__ = sys.modules[main.__module__].__doc__
    for module, defined in list(FLAGS.flags_by_module_dict().items()):
        if module.split(".")[0] in ("prism_jax", "experiments"):
            for flag in defined:
                FLAGS.register_key_flag_for_module(sys.argv[0], flag)
    gc.freeze()  # what was imported stays, and is not searched for garbage again
    keep_compiled()
    warnings.showwarning = functools.partial(_warned, name, set())
    logging.set_verbosity(logging.WARNING)
    try:
        if sys.stdout is None:
            raise InputError("stdout", "is closed", "send it to a file or /dev/null")
        if "--help" in sys.argv[1:]:  # of which absl makes a failure
            app.usage(shorthelp=True, writeto_stdout=True)
            sys.stdout.flush()
            sys.exit(0)
        with _interruptible():
            app.run(with_words, flags_parser=FLAGS)
    except InputError as error:
        _end(name, str(error))
    except flags.Error as error:
        _end(name, f"{' '.join(str(error).split())}; --help lists the flags")
    except OSError as error:
        if error.filename is None:
            # Stdout is full, or nobody reads it. Nor is it tried at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            _end(name, str(unwritable("stdout", error)))
        else:
            _end(name, str(unreadable(error.filename, error)))
    except KeyboardInterrupt:
        _end(name, "interrupted", status=130)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C interrupts. Python drops what is raised in a callback, as JAX has one for
    collecting garbage: then the interrupt comes again, when something else runs."""

    def again(dropped: Any) -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            return told(dropped)
        main = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, (main, signal.SIGINT)).start()

    before, told = signal.getsignal(signal.SIGINT), sys.unraisablehook
    sys.unraisablehook = again
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = told


def keep_compiled() -> None:
    """Has JAX keep what it compiles in the cache folder, for the next run.
    $JAX_COMPILATION_CACHE_DIR says where else; set to nothing, that nothing is kept."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(default_cache_dir() / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _warned(command: str, told: set[str], message: Any, *_: Any) -> None:
    """Tells a warning in one line, once. JAX never writes an entry of its cache anew
    that it cannot read: that is removed."""
    text = " ".join(str(message).split())
    form = "Error (reading|writing) persistent compilation cache entry for '(.*?)': "
    found = re.match(form, text)
    if found and found[1] == "writing":
        text = f"compiled programs cannot be kept: {text[found.end() :]}"
    elif found:
        text = "damaged programs in the cache are compiled again"
        kept = pathlib.Path(jax.config.jax_compilation_cache_dir)  # pyright: ignore
        for entry in kept.glob(f"{found[2]}-*"):
            entry.unlink(missing_ok=True)
    if text not in told:
        told.add(text)
        say(command, text)


def say(command: str, text: str) -> None:
    """One line to the user, on stderr. Where that is full, the work goes on."""
    with contextlib.suppress(OSError):
        print(f"{command}: {text}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def timed(
    command: str, text: str, name: str, seconds: dict[str, float]
) -> Iterator[None]:
    """Puts the time it took into `seconds`; says on stderr what takes long."""
    start = time.perf_counter()
    timer = threading.Timer(PATIENCE, say, (command, f"{text} ..."))
    timer.daemon = True
    timer.start()
    try:
        yield
        seconds[name] = time.perf_counter() - start
        if seconds[name] > PATIENCE:
            say(command, f"... done in {seconds[name]:.1f} s")
    finally:
        timer.cancel()


@functools.cache
def load_completer(weights: str, quick: bool = False) -> Any:
    """The completer, imported this late so that bad input is refused in a moment. The
    same one for the same weights, so that several scans compile once."""
    from prism_jax.completion.completer import Completer

    return Completer.from_pretrained(weights, default_cache_dir() / "compiled", quick)


@functools.cache
def load_library(folder: str | None, unit: str | None) -> Any:
    """The models of a folder, the same ones for several scans; None without one."""
    if folder is None and unit is not None:
        raise InputError("--known_unit", "needs models", "set --known too")
    if folder is None:
        return None
    from prism_jax.registration.library import Library

    return Library.from_folder(folder, unit)


def _end(name: str, fault: str, status: int = 2) -> None:
    say(name, fault)
    sys.exit(status)
