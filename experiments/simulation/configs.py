"""What the configurations of all sets of examples share."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from experiments.simulation.kinds import KINDS
from prism_jax.io.errors import InputError, choose


@dataclasses.dataclass(frozen=True)
class SetConfig:
    """What a split is made of. The manifest holds it; what makes no sense raises
    InputError. A number that is 0 becomes the split's own, of `SIZES`. Every prefix of
    a set is the same, whatever its size."""

    SIZES: ClassVar[Mapping[str, Mapping[str, int]]]

    split: str

    def __post_init__(self):
        choose("split", self.split, self.SIZES)
        for name, number in self.SIZES[self.split].items():
            if getattr(self, name) == 0:
                object.__setattr__(self, name, number)
        for field in dataclasses.fields(self):
            value, lowest = getattr(self, field.name), 0 if field.name == "seed" else 1
            if field.name == "partial":
                choose("partial", value, KINDS)
            elif isinstance(value, int) and not lowest <= value < 2**31:
                fault = f"{value} is not within {lowest} to {2**31 - 1}"
                raise InputError(field.name, fault, "choose another number")

    def content(self, generator: str, version: int, **more: Any) -> dict[str, Any]:
        """Everything that the bytes depend on, as a manifest has it."""
        name = {"generator": f"prism_jax {generator}", "generator_version": version}
        return {**name, **dataclasses.asdict(self), **more}


def shards_of(count: int, size: int) -> list[range]:
    """The numbers below a count, shard by shard."""
    return [range(count)[start : start + size] for start in range(0, count, size)]
