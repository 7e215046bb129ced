"""Views cut off by the edge of the image or by the box that somebody works in."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from experiments.simulation.raycast import Scene
from experiments.simulation.readings import Readings
from prism_jax.geometry.camera import camera_axes
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN

KEPT_SHARES = (0.25, 0.85)  # least and most of the points that a cut leaves


class Cut(NamedTuple):
    """The convex part of space that is kept."""

    planes: Float64[np.ndarray, "K 4"]  # normal and offset each; `n x <= d` is kept
    # Whether what was measured outside is known all the same, as where points are cut
    # to a workspace and the depth image is not. It is no part of the object then.
    known: bool = False

    def apply(self, readings: Readings, eye: Float[np.ndarray, "3"]) -> Readings:
        """The same readings of rays from `eye`, without what lies outside.

        What is not known is `UNKNOWN`. What is, and was of the object, is `NEARER`
        where the part that is kept lies behind it, and `BACKGROUND` elsewhere.
        """
        state, outside = readings.state.copy(), ~self.holds(readings.points)
        if self.known:
            outside &= state == SURFACE
            hides = self._is_entered_beyond(eye, readings.points[outside])
            state[outside] = np.where(hides, NEARER, BACKGROUND)
        else:
            state[outside] = UNKNOWN
        return readings._replace(state=state)

    def holds(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Which points are kept."""
        return np.all(points @ self.planes[:, :3].T <= self.planes[:, 3], axis=1)

    def _is_entered_beyond(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Whether the ray from the eye through a point outside enters behind it."""
        slopes = (points - eye) @ self.planes[:, :3].T
        room = self.planes[:, 3] - self.planes[:, :3] @ eye
        with np.errstate(divide="ignore", invalid="ignore"):
            meets = room / slopes
        entry = np.where(slopes < 0, meets, 1.0).max(axis=1, initial=1.0)
        leave = np.where(slopes > 0, meets, np.inf).min(axis=1, initial=np.inf)
        return (entry < leave) & ~((slopes == 0) & (room < 0)).any(axis=1)


NO_CUT = Cut(np.zeros((0, 4)))


def random_cut(
    scene: Scene,
    eye: Float[np.ndarray, "3"],
    seen: Float[np.ndarray, "N 3"],
    rng: np.random.Generator,
) -> Cut:
    """A cut that leaves between the two `KEPT_SHARES` of the points that would be seen.

    In one case of three each: by one or two edges of the image of a camera at `eye`
    that looks at the object's middle; by a half space of any direction; by an upright
    box, two to four of whose sides cut the object and the others stand clear of it.
    What a half space or a box leaves away is known half of the time.
    """
    share, kind = rng.uniform(*KEPT_SHARES), rng.integers(3)
    if kind == 0:
        right, down, forward = camera_axes(scene.center - eye)
        sides = rng.permutation([right, -right, down, -down])[: rng.integers(1, 3)]
        return Cut(_planes(sides, seen, share, eye, forward))
    known = bool(rng.random() < 0.5)
    if kind == 1:
        side = rng.normal(size=3)
        return Cut(_planes([side / np.linalg.norm(side)], seen, share), known)
    angle = rng.uniform(0, np.pi / 2)
    cosine, sine = np.cos(angle), np.sin(angle)
    along = np.array([(cosine, sine, 0), (-sine, cosine, 0), (0, 0, 1)])
    sides = rng.permutation(np.concatenate([along, -along]))
    cutting, clear = np.split(sides, [rng.integers(2, 5)])
    offsets = (np.asarray(scene.mesh.vertices) @ clear.T).max(axis=0)
    offsets += rng.uniform(0.05, 1.0, len(clear))
    planes = np.concatenate([clear, offsets[:, None]], axis=1)
    return Cut(np.concatenate([_planes(cutting, seen, share), planes]), known)


def _planes(
    sides: Sequence[np.ndarray] | np.ndarray,
    seen: np.ndarray,
    share: float,
    eye: np.ndarray | None = None,
    forward: np.ndarray | None = None,
) -> np.ndarray:
    """Planes that cut the points from these sides, each as much, and leave this share.

    Normals are the sides; where an eye looks forward, the planes pass through it and
    are edges of its image.
    """
    planes = []
    for side in sides:
        values = seen @ side
        if forward is not None:
            values = (seen - eye) @ side / ((seen - eye) @ forward)
        bound = np.quantile(values, share ** (1 / len(sides)), method="higher")
        # Rounding must not cut off the point that decides it.
        bound += 1e-9
        seen = seen[values <= bound]
        if forward is None:
            planes.append((*side, bound))
        else:
            normal = side - bound * forward
            planes.append((*normal, normal @ eye))
    return np.array(planes)
