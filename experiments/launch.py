"""What the launchers share: a quiet log, and faults of the input in one line."""

import sys
from collections.abc import Callable, Sequence

from absl import app, logging

from prism_jax.io.errors import InputError


def launch(name: str, main: Callable[[Sequence[str]], None]) -> None:
    """Runs ``main`` under absl; an `InputError` ends in one line and exit status 2."""
    logging.set_verbosity(logging.WARNING)
    try:
        app.run(main)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(2)
