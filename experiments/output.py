"""Where a launcher writes its result."""

import pathlib

from prism_jax.io.atomic import make_output_dir
from prism_jax.io.errors import InputError


def prepare_output(path: str | None, suffix: str, flag: str = "--output") -> None:
    """Makes the folder of an output, which `flag` names.

    Raises InputError for one that could not be written at the end, or whose name does
    not end in ``suffix``.
    """
    if path is None:
        return
    if pathlib.Path(path).suffix != suffix:
        remedy = f"use the suffix {suffix}"
        raise InputError(flag, f"{path} is not a {suffix} file", remedy)
    make_output_dir(pathlib.Path(path).parent)
