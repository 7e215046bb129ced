import dataclasses

import numpy as np
import pytest
import trimesh

from experiments.simulation.roboarm import cell_views
from experiments.simulation.roboarm.cell_views import make_cell_view
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.roboarm.workcells import make_workcell
from experiments.simulation.sensors import L515Config
from prism_jax.data.recordings import DEPTH_SCALE, LABELS
from prism_jax.geometry.visibility import (
    NEARER,
    UNKNOWN,
    look_up,
)
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.depth import points_from_depth
from prism_jax.preprocessing.visibility_map import seen_among

SENSOR = L515Config().exact()


@pytest.fixture(scope="module")
def seen(model):
    """Cells, each with a view by an exact sensor; some have people and some are cut."""
    model = dataclasses.replace(model, tool_link="lower")
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        try:
            cell = make_workcell(model, 1, rng, (120, 160))
            found.append((cell, make_cell_view(cell, 0, rng, SENSOR, 0.4, 256, 512)))
        except ValueError:
            continue
        if len(found) == 6:
            break
    assert {view.cut for _, view in found} == {False, True}
    assert any(len(cell.people.faces) for cell, _ in found)
    return found


def gaps(points, cell, *names):
    parts = cell.parts(0)
    mesh = together([parts[name] for name in names])
    return trimesh.proximity.closest_point_naive(mesh, points[::8].astype(float))[1]


def test_the_map_is_what_a_whole_image_tells_without_labels(seen):
    """`seen_among` of the object's pixels and all others. Its cube is not the cell's
    box, so hidden and background are compared as one: measured beside."""
    agree = []
    for cell, view in seen:
        if view.cut:
            continue
        depth = (view.depth * DEPTH_SCALE).reshape(-1)
        rays = cell_views.pixel_rays(view.camera)
        own = cell_views._measured(depth, view.labels, rays, cell)
        points = view.eye + depth[:, None] * rays
        among = points[own], points[~own & (depth > 0)]
        cube = Workspace.from_points(among[0], 1.4)
        known = seen_among(*among, view.eye.astype(float), cube)
        kinds = [np.minimum(one.state, NEARER) for one in (known, view.visibility)]
        agree.append(np.mean(kinds[0] == kinds[1]))
        both = (kinds[0] == kinds[1]) & (kinds[0] != UNKNOWN)
        gap = np.abs(known.depth - view.visibility.depth)[both]
        assert np.mean(gap < 0.02) > 0.97
    assert min(agree) > 0.95 and len(agree) > 2


def test_who_stands_before_the_cell_is_nearer(seen):
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
        assert gaps(view.complete, cell, "robot", "fixture").max() < 1e-5
    assert np.sum(np.concatenate(found)) > 100
    assert np.mean(np.concatenate(found)) > 0.4
