"""What every command shares: a quiet log, and the user's mistakes in one line."""

import io
import os
import sys
from collections.abc import Callable, Sequence

import jax
from absl import app, flags, logging

from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir

FLAGS = flags.FLAGS


class SomeFailed(Exception):
    """Several inputs were asked for, and some could not be used; the lines say why."""


def launch(name: str, main: Callable[..., None], takes_words: bool = False) -> None:
    """Runs ``main`` under absl.

    An `InputError` or a fault in the flags ends in one line on stderr and status 2,
    `SomeFailed` in a line for each and status 1, Ctrl-C in one line and status 130.
    ``main`` gets the words that are no flags if it takes them; else there must be none.
    """

    def with_words(argv: Sequence[str]) -> None:
        if takes_words:
            return main(argv[1:])
        if len(argv) > 1:
            raise InputError(argv[1], "not a flag", "write flags as --name=value")
        return main()

    if isinstance(sys.stdout, io.TextIOWrapper):
        # A folder's name may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    # --help lists the flags of the program that was started, and that may be a wrapper.
    for flag in FLAGS.get_flags_for_module(main.__module__):
        FLAGS.register_key_flag_for_module(sys.argv[0], flag)
    keep_compiled()
    logging.set_verbosity(logging.WARNING)
    try:
        app.run(with_words, flags_parser=FLAGS)
    except InputError as error:
        _end(name, str(error))
    except SomeFailed as error:
        _end(name, f"\n{name}: ".join(error.args[0]), status=1)
    except flags.Error as error:
        _end(name, f"{' '.join(str(error).split())}; --help lists the flags")
    except KeyboardInterrupt:
        _end(name, "interrupted", status=130)


def keep_compiled() -> None:
    """Has JAX keep what it compiles in the cache folder, for the next run.

    $JAX_COMPILATION_CACHE_DIR says where else; set to nothing, that nothing is kept.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = str(default_cache_dir() / "jax")
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _end(name: str, fault: str, status: int = 2) -> None:
    print(f"{name}: {fault}", file=sys.stderr)
    sys.exit(status)
