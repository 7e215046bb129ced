"""Which catalogues of models there are, under which licences, and whose split is whose.

They come with the Debian package `sweethome3d-furniture`. No file of theirs is part of
prism_jax.
"""

import os
import pathlib
from typing import NamedTuple

from experiments.simulation.objects.models import Model
from experiments.simulation.objects.sweet_home import read_catalogue
from prism_jax.io.errors import InputError

PACKAGE = "sweethome3d-furniture"
FOLDER = pathlib.Path("/usr/share/sweethome3d/furniture")
"""Where Debian puts the catalogues."""


class Catalogue(NamedTuple):
    """A file of models by one maker, or from one place."""

    name: str  # of the file, without `.sh3f`
    split: str  # what all its models belong to
    licence: str  # as the package's copyright file and its own give it


CATALOGUES = (
    Catalogue("Scopia", "test", "CC BY 3.0"),
    Catalogue("KatorLegaz", "validation", "CC BY 3.0 US"),
    Catalogue("Reallusion", "validation", "CC BY 3.0 US"),
    Catalogue("BlendSwap-CC-0", "train", "CC0 1.0"),
    Catalogue("BlendSwap-CC-BY", "train", "CC BY 3.0"),
)
"""Splits were fixed before anything was trained on them. A model that two catalogues
have counts as the first one's, so that training never sees what is tested."""


def read_installed(
    catalogue: Catalogue, folder: str | os.PathLike = FOLDER
) -> tuple[str, list[Model]]:
    """A catalogue's version and models; InputError where it is not installed."""
    path = pathlib.Path(folder) / f"{catalogue.name}.sh3f"
    if not path.is_file():
        remedy = f"install {PACKAGE}: apt-get install {PACKAGE}"
        raise InputError(path, "no such catalogue of models", remedy)
    return read_catalogue(path, catalogue.licence)
