"""What a catalogue says of a mesh that somebody made."""

import dataclasses
from collections.abc import Callable

import trimesh


@dataclasses.dataclass(frozen=True)
class Model:
    """A mesh that somebody made, with whom to thank for it.

    Attributes:
      catalogue: name of the catalogue that it is in.
      name: what tells it from the catalogue's others.
      title: what it shows, in English.
      creator: who made it.
      licence: under which it may be used.
      load: its mesh, z up and front along +y, in any unit; InputError where it cannot
        be read. Can be pickled.
      fault: why it is no object, if its catalogue says so; else None.
    """

    catalogue: str
    name: str
    title: str
    creator: str
    licence: str
    load: Callable[[], trimesh.Trimesh]
    fault: str | None = None

    @property
    def identity(self) -> str:
        """Tells it from all other models."""
        return f"{self.catalogue}/{self.name}"
