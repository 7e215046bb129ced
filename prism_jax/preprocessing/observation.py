"""What the network reads of one scan."""

import dataclasses
import functools
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from prism_jax.geometry.camera import Camera, Vector
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.geometry.workspace import CUBE_MARGIN, Workspace
from prism_jax.preprocessing.heading import level_heading
from prism_jax.preprocessing.outliers import far_outliers
from prism_jax.preprocessing.sensor import is_believable, likely_eye
from prism_jax.preprocessing.upright import upright

Heading = Literal["given", "level"]
"""Which heading a network knows objects in: the given one, or `level_heading`'s."""


@runtime_checkable
class Framing(Protocol):
    """How a model frames clouds; `prism_jax.models.config.ModelConfig` is one."""

    @property
    def margin(self) -> float: ...

    @property
    def heading(self) -> Heading: ...


UNKNOWN_EYE = np.sqrt(3.0) * np.ones(3)
"""Where the sensor is taken to be, in the unit workspace, if nobody knows: in the
direction of the view `front_left_top`."""

FAR_ORIGIN = 100.0
"""In half extents of the workspace: an origin farther off is a map's, no sensor's; one
within the workspace is an object's own, whose coordinates were centred."""

_framing = jax.jit(Camera.framing)
_farthest = jax.jit(farthest_point_sample, static_argnums=1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observation:
    """Points and a sensor in the unit workspace, and the way back.

    A pytree: it can be traced, stacked and mapped with ``jax.vmap``. Arrays are NumPy's
    in double precision where the points were NumPy's; networks read float32.

    Attributes:
      partial: every given point in the workspace's frame and unit, upright.
      eye: the sensor's place there.
      workspace: from the user's frame to that one.
      inside: which points the workspace holds; the others are to be left out.
      sensor_known: False if nobody said where the sensor was, and it is taken to be
        obliquely above, at `UNKNOWN_EYE`.
    """

    # JAX rebuilds pytrees with placeholders for leaves; do not type-check those.
    __no_type_check__ = True

    partial: Float[Array | np.ndarray, "*batch N 3"]
    eye: Float[Array | np.ndarray, "*batch 3"]
    workspace: Workspace
    inside: Bool[Array | np.ndarray, "*batch N"]
    sensor_known: Bool[Array | np.ndarray, "*batch"]

    @property
    def camera(self) -> Camera:
        """The view that depths are compared in: from the eye, filled by the partial.

        In float32 and the unit workspace. Differentiable.
        """
        return _framing(self.partial, self.eye)

    @functools.cached_property
    def cloud(self) -> IndexedCloud:
        """The points inside, or enough of them. Not traced."""
        inside = np.asarray(self.partial)[np.asarray(self.inside)]
        return IndexedCloud.of_enough(inside)

    def sampled(self, num_points: int) -> "Observation":
        """The same with ``num_points`` of the points inside, in farthest-point order.

        Fewer are repeated; see `geometry.sampling.resample`. In float32. Not traced:
        how many are inside must be known. Clouds of any size need few compilations.
        """
        points = self.cloud.points.astype(np.float32)
        # Where there are fewer, all of them come before the copies.
        order = np.asarray(_farthest(padded(points, num_points), num_points))
        order = np.resize(order[: len(points)], num_points)
        chosen = jnp.asarray(points[order])
        inside = np.ones(num_points, bool)
        return dataclasses.replace(self, partial=chosen, inside=inside)

    def filled(self) -> "Observation":
        """The same with copies of the first point inside in place of those outside.

        For where the number of points is fixed, as under ``jit``.
        """
        first = self.partial[self.inside.argmax()]
        xp: Any = jnp if isinstance(self.partial, jax.Array) else np
        filled = xp.where(self.inside[:, None], self.partial, first)
        return dataclasses.replace(self, partial=filled)

    def camera_to_user(self, camera: Camera) -> Camera:
        """A camera of the unit workspace, for points in the user's frame.

        In double precision, and its rotation one to that precision: the frame's origin
        may be far away. Not traced.
        """
        camera = jax.tree.map(_double, camera)
        left, _, right = np.linalg.svd(camera.rotation)
        exact = dataclasses.replace(camera, rotation=left @ right)
        return jax.tree.map(_double, self.workspace).camera_from_unit(exact)


def observe(
    points: Float[Array | np.ndarray, "N 3"],
    sensor: Vector | Literal["origin", "likely"] | None,
    frame: Framing | Workspace,
    up: str | Vector = "z",
) -> Observation:
    """The network's input, from points and a sensor position in the user's frame.

    `sensor` is the sensor position; None or a non-finite one means unknown. "origin"
    is for points in the sensor's own frame: the position is the origin, or unknown if
    the origin is implausible, that is inside the workspace or more than `FAR_ORIGIN`
    half extents from its centre. "likely", for NumPy alone, is the same, but in place
    of an unknown position, or of an origin that is not believed, it takes `likely_eye`.

    `frame` is the model's configuration (`config.model`), whose margin and heading
    make the cube to complete, `workspace_around` the points; only outliers
    (`far_outliers`) can lie outside that. Or it is the cube itself: points outside it
    are not ``inside``, and without a rotation it takes its axes from `up`.

    With NumPy points all is in double precision, for frames with a far origin. With
    JAX arrays it can be jitted and mapped; use ``points`` near the origin then.
    Differentiable, except for ``inside``. An empty cloud raises ValueError; points
    must be finite.
    """
    if not (isinstance(sensor, str) and sensor == "likely"):
        return _framed(points, sensor, frame, up)
    seen = _framed(points, "origin", frame, up)
    if not seen.inside.any():
        return seen
    inside = np.asarray(points)[seen.inside]
    likely = likely_eye(inside, seen.workspace.up)
    if seen.sensor_known and is_believable(inside, np.zeros(3), likely):
        return seen
    seen = _framed(points, likely, frame, up)
    return dataclasses.replace(seen, sensor_known=np.bool_(False))


def _framed(
    points: Float[Array | np.ndarray, "N 3"],
    sensor: Vector | Literal["origin"] | None,
    frame: Framing | Workspace,
    up: str | Vector,
) -> Observation:
    """What was observed, with the sensor where it is said to be."""
    xp: Any = jnp if isinstance(points, jax.Array) else np
    counted = False  # points by which the cube is decided
    if not isinstance(frame, Workspace):
        counted = ~far_outliers(points)
        framing = frame.margin, up, frame.heading, counted
        workspace = workspace_around(points, sensor, *framing)
    else:
        workspace = jax.tree.map(_double, frame) if xp is np else frame
        if workspace.rotation is None:
            workspace = dataclasses.replace(workspace, rotation=upright(up))
    partial = workspace.to_unit(points)
    # Rounding must not leave out what decided the cube.
    inside = _within(partial) | counted
    eye, known = _place(sensor, workspace, xp)
    return Observation(partial, eye, workspace, inside, known)


def workspace_around(
    points: Float[Array | np.ndarray, "N 3"],
    sensor: Vector | Literal["origin"] | None = None,
    margin: float = CUBE_MARGIN,
    up: str | Vector = "z",
    heading: Heading = "given",
    where: Bool[Array | np.ndarray, " N"] | None = None,
) -> Workspace:
    """The cube around a partial cloud: the longest side of its box times `margin`.

    `up` is the direction of the user's frame that points upwards, as `upright` has it:
    the weights know upright objects. With the `heading` "level" the cube is turned
    about it as `level_heading` says; with "given" it is not. `sensor` is as for
    `observe`, and the points that `where` marks, or all, are as `Workspace.from_points`
    has them.
    """
    workspace = Workspace.from_points(points, margin, upright(up), where)
    if heading == "given":
        return workspace
    xp: Any = jnp if isinstance(points, jax.Array) else np
    eye, known = _place(sensor, workspace, xp)
    counting = xp.ones(points.shape[0], bool) if where is None else where
    turn = level_heading(workspace.to_unit(points), eye, known, counting)
    if workspace.rotation is not None:
        turn = turn @ workspace.rotation
    return Workspace.from_points(points, margin, turn, where)


def framed_view(
    partial: Float[Array | np.ndarray, "N 3"],
    eye: Float[Array | np.ndarray, "3"],
) -> Camera:
    """The view that depths of a cloud in the unit workspace are compared in: from the
    eye, or from `UNKNOWN_EYE` if that is not finite. Differentiable."""
    return observe(partial, eye, Workspace.unit()).camera


def origin_is_sensor(points: Float[np.ndarray, "N 3"]) -> bool:
    """Whether a whole cloud's sensor can have stood at the origin; see `observe`."""
    cube = workspace_around(points, where=~far_outliers(points))
    return bool(_place("origin", cube, np)[1])


def compile_sampling(num_points: int, most: int) -> None:
    """Compiles `Observation.sampled` for clouds of up to `most` points.

    A quarter of a second for each power of two, for who cannot wait in between.
    """
    least, largest = ((max(n, num_points) - 1).bit_length() for n in (1, most))
    for power in range(least, largest + 1):
        points = np.zeros((1 << power, 3), np.float32)
        jax.block_until_ready(_farthest(points, num_points))


def padded(
    points: Float[np.ndarray, "N 3"], least: int = 1
) -> Float[np.ndarray, "M 3"]:
    """The cloud with copies of its first point, up to a power of two not under `least`.

    Clouds of any size then need few compilations. Neither farthest-point sampling nor a
    depth map sees the copies.
    """
    count = 1 << (max(len(points), least) - 1).bit_length()
    copies = np.broadcast_to(points[0], (count - len(points), 3))
    return np.concatenate([points, copies])


def _place(sensor: Any, workspace: Workspace, xp: Any) -> tuple[Any, Any]:
    """The sensor's place in the workspace, and whether it is known."""
    if sensor is None:
        sensor = np.full(3, np.nan)
    at_origin = isinstance(sensor, str)
    eye = workspace.to_unit(xp.asarray(np.zeros(3) if at_origin else sensor))
    known = xp.isfinite(eye).all(axis=-1)
    if at_origin:
        distance = xp.linalg.norm(eye, axis=-1)
        known &= ~_within(eye) & (distance <= FAR_ORIGIN)
    return xp.where(known, eye, UNKNOWN_EYE.astype(eye.dtype)), known


def _within(unit: Any) -> Any:
    return (abs(unit) <= 1.0).all(axis=-1)


def _double(array: Any) -> np.ndarray:
    return np.asarray(array, np.float64)
