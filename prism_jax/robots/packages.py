"""The files that robots name."""

import pathlib

from prism_jax.io.errors import InputError


def named_file(name: str, beside: pathlib.Path) -> pathlib.Path | None:
    """Where a name in a robot's file leads: beside that file, or in the package that it
    names, which is looked for in the folders above it; None if nowhere. A scheme other
    than package:// and file:// raises InputError."""
    scheme, found, rest = name.partition("://")
    if found and scheme not in ("package", "file"):
        fault = f"{scheme}:// is not supported"
        raise InputError(beside, fault, "use package:// or a path")
    places = [beside.parent / (rest if found else name)]
    if scheme == "package":
        places = [folder / rest for folder in beside.parents]
        places += [folder / rest.partition("/")[2] for folder in beside.parents]
    return next((place for place in places if place.is_file()), None)
