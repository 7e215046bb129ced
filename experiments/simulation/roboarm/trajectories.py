"""Smooth, collision-free joint trajectories between random way-points.

Between two way-points every joint follows the fifth-degree polynomial that has the
least jerk from rest to rest (Flash & Hogan 1985, "The coordination of arm movements").
"""

import numpy as np
from jaxtyping import Bool, Float, Float64

from experiments.simulation.roboarm.robots import Robot
from prism_jax.io.errors import InputError

FLOOR_GAP = 0.015  # metres of moving parts above the plane that an arm stands on
SELF_GAP = 0.03  # metres between the probes of bodies that no single joint connects
CHECKS = 12  # poses looked at on the way from one way-point to the next
_DRAWS = 32
_MAX_DRAWS = 100 * _DRAWS


def minimum_jerk(
    start: Float[np.ndarray, " J"],
    end: Float[np.ndarray, " J"],
    times: Float[np.ndarray, " T"],
) -> Float64[np.ndarray, "T J"]:
    """Positions at times 0 to 1 of the movement of least jerk, at rest at both ends."""
    share = times**3 * (10 - 15 * times + 6 * times**2)
    return start + share[:, None] * (end - start)


def random_trajectory(
    robot: Robot, num_frames: int, num_waypoints: int, rng: np.random.Generator
) -> Float64[np.ndarray, "T J"]:
    """Joint positions of `num_frames` frames, evenly spaced in time.

    Way-points are uniform within the limits; a leg that would meet the ground or the
    arm itself is shortened. A robot that is never free raises InputError.
    """
    clearance = Clearance(robot)
    waypoints = [_random_free_pose(robot, clearance, rng)]
    for _ in range(num_waypoints - 1):
        target = _random_free_pose(robot, clearance, rng)
        waypoints.append(_reachable(clearance, waypoints[-1], target))
    times = np.linspace(0, num_waypoints - 1, num_frames)
    legs = np.minimum(times.astype(int), num_waypoints - 2)
    rows = [
        minimum_jerk(waypoints[leg], waypoints[leg + 1], np.array([time - leg]))[0]
        for time, leg in zip(times, legs, strict=True)
    ]
    return np.stack(rows)


class Clearance:
    """Which poses keep a robot clear of itself and of the ground (z = 0 of its frame,
    which the root alone may touch).

    Bodies may touch where one joint, or two in a row, connect them, and where they do
    in most poses: a short wrist's hand and forearm.
    """

    def __init__(self, robot: Robot):
        self._robot = robot
        self._bodies = robot.bodies[robot.probe_links]
        self._pairs = _unconnected_pairs(robot)
        rng = np.random.default_rng(0)
        drawn = rng.uniform(robot.lower, robot.upper, (_DRAWS, len(robot.lower)))
        probes = robot.probe_points(drawn)
        self._pairs = [
            pair
            for pair in self._pairs
            if 2 * sum(self._touch(points, *pair) for points in probes) < _DRAWS
        ]

    def is_free(self, positions: Float[np.ndarray, "P J"]) -> Bool[np.ndarray, " P"]:
        """Whether each pose is clear."""
        probes = self._robot.probe_points(positions)
        free = np.min(probes[:, self._bodies > 0, 2], axis=1, initial=1) > FLOOR_GAP
        for pose in np.flatnonzero(free):
            free[pose] = not any(self._touch(probes[pose], *p) for p in self._pairs)
        return free

    def _touch(self, points: np.ndarray, first: int, second: int) -> bool:
        one, other = points[self._bodies == first], points[self._bodies == second]
        gaps = one[:, None] - other[None]
        return bool((np.einsum("abk,abk->ab", gaps, gaps) < SELF_GAP**2).any())


def _unconnected_pairs(robot: Robot) -> list[tuple[int, int]]:
    """Pairs of bodies with a mesh that are more than two joints apart."""
    near = np.eye(len(robot.parents), dtype=int)
    for body, carrier in enumerate(robot.parents):
        near[body, carrier] = near[carrier, body] = 1
    near, with_mesh = near @ near, sorted(set(robot.bodies.tolist()))
    return [(a, b) for a in with_mesh for b in with_mesh if a < b and not near[a, b]]


def _random_free_pose(
    robot: Robot, clearance: Clearance, rng: np.random.Generator
) -> np.ndarray:
    for _ in range(_MAX_DRAWS // _DRAWS):
        drawn = rng.uniform(robot.lower, robot.upper, (_DRAWS, len(robot.lower)))
        free = clearance.is_free(drawn)
        if free.any():
            return drawn[np.argmax(free)]
    fault = f"collides with itself or the ground in {_MAX_DRAWS} random poses"
    remedy = "use the arm without its base, and check its joint limits"
    raise InputError(robot.name, fault, remedy)


def _reachable(
    clearance: Clearance, start: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """The farthest way-point towards the target with a free leg; at worst the start."""
    steps = np.linspace(0, 1, CHECKS)
    for share in (1.0, 0.8, 0.6, 0.4, 0.2, 0.1):
        end = start + share * (target - start)
        if clearance.is_free(minimum_jerk(start, end, steps)).all():
            return end
    return start
