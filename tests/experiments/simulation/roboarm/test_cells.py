"""Varied cells: what their cameras know, and the set that is built of them."""

import dataclasses

import numpy as np
import pytest
import trimesh

from experiments.simulation.roboarm.cell_views import make_cell_view
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.roboarm.workcells import make_workcell
from experiments.simulation.sensors import L515Config
from prism_jax.data.recordings import DEPTH_SCALE, LABELS
from prism_jax.geometry.visibility import NEARER, UNKNOWN, look_up
from prism_jax.io.depth import points_from_depth

SENSOR = L515Config().exact()


@pytest.fixture(scope="module")
def seen(model):
    """Whole cells, each with a view by an exact sensor."""
    model = dataclasses.replace(model, tool_link="lower")
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        try:
            cell = make_workcell(model, 1, rng, (120, 160))
            found.append((cell, make_cell_view(cell, 0, rng, SENSOR, 0.0, 256, 512)))
        except ValueError:
            continue
        if len(found) == 4:
            return found
    raise AssertionError("no cells")


def test_who_stands_before_the_cell_is_nearer_and_not_in_the_truth(seen):
    """A ball between camera and cell, in the place of all people."""
    found = []
    for cell, _ in seen[:3]:
        eye = np.asarray(cell.camera.position)
        away = 0.4 * ((cell.lower + cell.upper) / 2 - eye)
        ball = trimesh.creation.icosphere(2, 0.12 * np.linalg.norm(away))
        ball.apply_translation(eye + away)
        rng = np.random.default_rng(0)
        before = dataclasses.replace(cell, people=ball)
        view = make_cell_view(before, 0, rng, SENSOR, 0.0, 256, 512)
        people = view.labels == LABELS["person"]
        points = points_from_depth(view.depth * DEPTH_SCALE, people, view.camera)
        state, behind = look_up(view.visibility, points)
        state = state[np.abs(behind) < 0.02]
        # Pixels of the map that no ray of a small image went through are unknown.
        assert np.isin(state, (NEARER, UNKNOWN)).all()
        found.append(state == NEARER)
        mesh = together([cell.parts(0)[name] for name in ("robot", "fixture")])
        points = view.complete[::8].astype(float)
        gaps = trimesh.proximity.closest_point_naive(mesh, points)[1]
        assert gaps.max() < 1e-5
    assert np.sum(np.concatenate(found)) > 100
    assert np.mean(np.concatenate(found)) > 0.4
