"""Kinds of views of a ball."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.kinds import MIXTURE, draw_kind, make_view
from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.views import MAX_DRAWS, MIN_RETURNS
from prism_jax.geometry.visibility import SURFACE, UNKNOWN, look_up


@pytest.fixture(scope="module")
def ball() -> Scene:
    """The unit ball, to a thousandth."""
    return Scene(trimesh.creation.icosphere(5))


@pytest.mark.parametrize("kind", MIXTURE)
def test_points_lie_on_the_object_and_the_map_knows_them(ball, kind):
    """And nothing of the object is called free."""
    rng = np.random.default_rng(0)
    complete = sample_outside(ball, 1000, rng)
    view = next(
        view
        for view in (
            make_view(kind, ball, complete, rng, 2048) for _ in range(MAX_DRAWS)
        )
        if len(view.points) >= MIN_RETURNS
    )
    parts, known = set(kind.split("+")), view.visibility
    assert view.kind == kind and known is not None
    off = np.abs(np.linalg.norm(view.points, axis=1) - 1)
    noise = 8 * np.median(off)
    assert parts & {"noisy", "rings"} or off.max() < 0.003
    assert np.median(off) < 0.1
    assert np.all((known.depth > 0) == (known.state != UNKNOWN))
    if "stations" not in parts:
        state, behind = look_up(known, view.points)
        assert np.all(state == SURFACE)
        assert -1e-5 < behind.min() <= np.median(behind) < 0.05
    state, behind = look_up(known, complete)
    # Between a few beams a pixel may hold more than they meet; where a cut or an
    # occluder ends, or grazing returns are lost, what was nearer than the rest of a
    # pixel is gone.
    front = behind < -0.01 - noise
    assert front.mean() < (0.1 if "rings" in parts else 0.01)
    if "rings" not in parts:
        broken = parts & {"occluded", "truncated", "noisy"}
        assert behind.min() > -0.05 - noise - (0.2 if broken else 0)


def test_kinds_are_drawn_as_often_as_their_weights_say():
    rng = np.random.default_rng(0)
    weights = {"clear": 3.0, "rings": 1.0, "noisy": 0.0}
    found = [draw_kind(rng, weights) for _ in range(400)]
    assert set(found) == {"clear", "rings"}
    assert np.mean(np.array(found) == "rings") == pytest.approx(0.25, abs=0.07)
