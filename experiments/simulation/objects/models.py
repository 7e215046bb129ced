"""What a catalogue says of a mesh that somebody made."""

import dataclasses
from collections.abc import Callable

import trimesh


@dataclasses.dataclass(frozen=True)
class Model:
    """A mesh that somebody made, with whom to thank for it."""

    catalogue: str
    name: str  # tells it from the catalogue's others
    title: str  # what it shows, in English
    creator: str
    licence: str
    # Its mesh, z up, front along +y, in any unit; InputError where it cannot be read.
    load: Callable[[], trimesh.Trimesh]
    fault: str | None = None  # why it is no object, if its catalogue says so

    @property
    def identity(self) -> str:
        """Tells it from all other models."""
        return f"{self.catalogue}/{self.name}"
