"""Commands that make data, train, score and draw: python -m experiments.NAME."""

import pathlib
import sys
from types import TracebackType

from prism_jax.io.errors import InputError

EXTRAS = {
    "train": ("grain", "optax", "orbax"),
    "data": ("embreex", "fpsample", "manifold3d", "trimesh"),
}
"""Packages that launchers import as they start, by the extra that installs them."""


def tell(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """A missing extra, or what else the user can put right, as one line on stderr; any
    other exception as Python has it."""
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    package = str(name).partition(".")[0]
    for extra, packages in EXTRAS.items():
        if package in packages:
            remedy = f'install the extra: pip install "prism_jax[{extra}]"'
            error = InputError(package, "not installed", remedy)
    if isinstance(error, InputError):
        print(f"{pathlib.Path(sys.argv[0]).stem}: {error}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = tell
