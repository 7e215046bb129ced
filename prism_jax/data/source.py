"""What every data set gives, and all that the pipeline knows of one."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Int

from prism_jax.geometry.visibility import Visibility
from prism_jax.io.clouds import check_cloud
from prism_jax.io.errors import StrPath
from prism_jax.io.files import parsing


class Example(NamedTuple):
    """One object or scene: the clouds as their source has them, none resampled."""

    # The ground truth; None where there is none.
    complete: Float32[np.ndarray, "M 3"] | None
    # What the sensor measured; None where the pipeline is to crop it from `complete`.
    partial: Float32[np.ndarray, "N 3"] | None
    # The sensor's position, in the frame and units of the clouds; None where the source
    # does not say.
    eye: Float32[np.ndarray, "3"] | None
    category: str  # one of the source's `categories`
    name: str  # unique within the source
    # Whether both clouds are in farthest-point order, so that every prefix is a
    # farthest-point sample.
    ordered: bool = False
    # Whether training may turn it about the vertical, z, at random: a robot cell, yes;
    # a chair whose front is along y, no.
    any_heading: bool = False
    # What the sensor knows of every direction, surface or emptiness; None where the
    # source does not say.
    visibility: Visibility | None = None


@runtime_checkable
class Source(Protocol):
    """A data set of Examples, read by index, as Grain wants its random-access sources.
    The same index gives the same arrays in every process. It can be pickled, and an
    index outside the range raises IndexError."""

    @property
    def categories(self) -> tuple[str, ...]:
        """The names that `Example.category` takes."""
        ...

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """The object that each item shows, from 0 on; its items follow one another."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Example: ...


def sound_cloud(
    points: Float[np.ndarray, "N 3"], subject: StrPath, num_points: int | None = None
) -> Float32[np.ndarray, "N 3"]:
    """The points as float32; another count, or what `check_cloud` refuses, raises
    InputError."""
    with parsing(subject, "a sound cloud", "copy this file again from the data set"):
        cloud = np.ascontiguousarray(points, np.float32)
        if num_points not in (None, len(cloud)):
            raise ValueError(f"{len(cloud)} points instead of {num_points}")
        check_cloud(cloud, subject)
    return cloud
