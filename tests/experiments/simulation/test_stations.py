"""Random sensors: where they stand, and what they are."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.kinds import (
    BEAMS,
    CAMERA_METRES,
    CLEARANCE,
    FARTHEST,
    LIDAR_METRES,
    random_camera,
    random_lidar,
)
from experiments.simulation.raycast import Scene
from experiments.simulation.sensors import L515Config, OusterConfig


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A box whose middle is not the origin."""
    return Scene(trimesh.creation.box(bounds=[(-1, -0.5, -0.3), (1, 0.3, 0.7)]))


@pytest.mark.parametrize("sort", ["exact", "noisy", "lidar"])
def test_sensors_stand_within_their_metres_and_clear_of_the_object(scene, sort):
    rng = np.random.default_rng(0)
    halves, beams = [], set()
    for _ in range(100):
        if sort == "lidar":
            sensor, metres = random_lidar(scene, 2, rng), LIDAR_METRES
            assert isinstance(sensor.config, OusterConfig) and sensor.has_rings
            assert BEAMS[sensor.config.beams] == sensor.config.elevation_degrees
            beams.add(sensor.config.beams)
        else:
            sensor, metres = (
                random_camera(scene, 2, sort == "noisy", rng),
                CAMERA_METRES,
            )
            exact = L515Config() if sort == "noisy" else L515Config().exact()
            assert sensor.config == exact and not sensor.has_rings
        halves.append(sensor.half_extent)
        assert len(sensor.eyes) == 2
        for eye in sensor.eyes:
            distance = np.linalg.norm(eye - scene.center)
            nearest = CLEARANCE * scene.radius
            assert distance >= max(nearest, metres[0] / sensor.half_extent) - 1e-9
            most = max(nearest, metres[1] / sensor.half_extent)
            assert distance <= min(most, np.inf if beams else FARTHEST) + 1e-9
    sides = {"exact": (1.2, 1.2), "noisy": (0.2, 3.0), "lidar": (0.5, 5.0)}[sort]
    assert sides[0] <= 2 * min(halves) and 2 * max(halves) <= sides[1]
    if sort != "exact":
        assert max(halves) > 5 * min(halves)
    assert beams == (set(BEAMS) if sort == "lidar" else set())
