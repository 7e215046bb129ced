"""What can befall a partial cloud when it is read, without anything being ray cast."""

import dataclasses

import numpy as np
from jaxtyping import Float

from prism_jax.data.source import Example
from prism_jax.geometry.visibility import SURFACE, UNKNOWN, Visibility
from prism_jax.io.errors import InputError


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """How much of it. Numbers that make no sense raise InputError."""

    crop: float = 0.0  # probability that a half space of any direction is cut off
    # Of the points, the least and the most that go with it.
    crop_shares: tuple[float, float] = (0.1, 0.6)
    # Probability that only some of the points are left, a random choice.
    thin: float = 0.0
    # How many at the least; how many there are is uniform in the logarithm.
    fewest: int = 128
    # The largest standard deviation of noise on every coordinate, in longest sides of
    # the partial; how large it is is uniform too.
    jitter: float = 0.0

    def __post_init__(self):
        least, most = self.crop_shares
        for name, share in {"crop": self.crop, "thin": self.thin}.items():
            if not 0 <= share <= 1:
                raise InputError(name, f"{share} is out of range", "choose 0 to 1")
        if not 0 <= least <= most < 1:
            remedy = "choose increasing shares from 0 to below 1"
            raise InputError("crop_shares", f"{least} to {most}", remedy)
        if self.fewest < 1 or not 0 <= self.jitter < np.inf:
            fault = f"fewest {self.fewest}, jitter {self.jitter}"
            raise InputError("augmentation", fault, "use fewest >= 1 and jitter >= 0")


def augmented(
    example: Example, settings: Augmentation, rng: np.random.Generator
) -> Example:
    """The example with another partial, in the order of the one it has. Of what the
    sensor knows, the surface that is cropped away is forgotten; thinning and noise
    leave it as it is. An example without a partial raises ValueError."""
    partial, visibility = example.partial, example.visibility
    if partial is None:
        raise ValueError(f"{example.name} has no partial to change")
    if rng.random() < settings.crop:
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        along = partial @ normal
        bound = np.quantile(along, 1 - rng.uniform(*settings.crop_shares))
        partial = partial[along <= bound]
        if visibility is not None:
            visibility = _forgotten(visibility, normal, float(bound))
    if rng.random() < settings.thin and len(partial) > settings.fewest:
        span = np.log((settings.fewest, len(partial) + 1))
        count = int(np.exp(rng.uniform(*span)))
        chosen = np.sort(rng.choice(len(partial), count, replace=False))
        partial = partial[chosen]
    if settings.jitter > 0:
        side = np.ptp(partial, axis=0).max()
        deviation = rng.uniform(0.0, settings.jitter) * side
        noise = deviation * rng.standard_normal(partial.shape)
        partial = (partial + noise).astype(np.float32)
    return example._replace(partial=partial, visibility=visibility)


def _forgotten(
    visibility: Visibility, normal: Float[np.ndarray, "3"], bound: float
) -> Visibility:
    """Without the surface that lies beyond a plane."""
    camera = visibility.camera
    direction = camera.rotation @ normal
    # Of each pixel's ray of depth one, in the camera's frame.
    slopes = np.linalg.inv(camera.intrinsics).T @ direction
    columns, rows = np.arange(camera.width), np.arange(camera.height)[:, None]
    slopes = columns * slopes[0] + rows * slopes[1] + slopes[2]
    along = visibility.depth * slopes - camera.translation @ direction
    beyond = (visibility.state == SURFACE) & (along > bound)
    return visibility._replace(
        state=np.where(beyond, np.uint8(UNKNOWN), visibility.state),
        depth=np.where(beyond, np.float32(0), visibility.depth),
    )
