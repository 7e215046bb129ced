"""Kinds of views of a body whose surface is known in closed form, and of boxes."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from experiments.simulation.kinds import MIXTURE, View, draw_kind, make_view
from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.views import MAX_DRAWS, MIN_RETURNS
from prism_jax.geometry.visibility import (
    MAP_SIZE,
    SURFACE,
    UNKNOWN,
    look_up,
)

NOISY = ("noisy", "rings")


@pytest.fixture(scope="module")
def ball() -> Scene:
    """The unit ball, to a thousandth."""
    return Scene(trimesh.creation.icosphere(5))


@pytest.fixture(scope="module")
def complete(ball) -> np.ndarray:
    return sample_outside(ball, 3000, np.random.default_rng(0))


def drawn(kind: str, scene: Scene, complete: np.ndarray, seed: int) -> View:
    """A view with points, as `views` draws it."""
    rng = np.random.default_rng(seed)
    for _ in range(MAX_DRAWS):
        view = make_view(kind, scene, complete, rng, 2048)
        if len(view.points) >= MIN_RETURNS:
            return view
    raise AssertionError(f"no view of {kind}")


@pytest.mark.parametrize("kind", MIXTURE)
def test_points_lie_on_the_object_and_the_map_knows_them(ball, complete, kind):
    """And of what is free nothing is called so that is not."""
    for seed in range(2):
        view = drawn(kind, ball, complete, seed)
        assert view.kind == kind
        radius = np.linalg.norm(view.points, axis=1)
        if not set(kind.split("+")) & set(NOISY):
            np.testing.assert_allclose(radius, 1, atol=0.003)
        assert np.median(np.abs(radius - 1)) < 0.1
        known = view.visibility
        assert known is not None
        assert known.state.shape == known.depth.shape == (MAP_SIZE, MAP_SIZE)
        assert np.all((known.depth > 0) == (known.state != UNKNOWN))
        if "stations" not in kind:
            state, behind = look_up(known, view.points)
            assert np.all(state == SURFACE)
            assert -1e-5 < behind.min() <= np.median(behind) < 0.05
        state, behind = look_up(known, complete)
        # Between a few beams a pixel may hold more than they meet; where a cut or an
        # occluder ends, or grazing returns are lost, what was nearer than the rest of a
        # pixel is gone.
        noise = 8 * np.median(np.abs(radius - 1))
        front = behind < -0.01 - noise
        assert front.mean() < (0.1 if "rings" in kind else 0.01)
        if "rings" not in kind:
            assert np.sum(front & (state != SURFACE)) <= 3
            broken = {"occluded", "truncated", "noisy"} & set(kind.split("+"))
            assert behind.min() > -0.05 - noise - (0.2 if broken else 0)


def test_occluded_views_see_less_and_truncated_ones_are_cut(ball, complete):
    """By how much is measured of the cap that faces the eye."""
    shares = {"clear": [], "occluded": [], "truncated": []}
    for kind, found in shares.items():
        for seed in range(12):
            view = drawn(kind, ball, complete, seed)
            distance = np.linalg.norm(view.eye)
            cap = complete[complete @ view.eye > 1 + 0.1 * distance]
            gaps = KDTree(view.points).query(cap)[0]
            found.append(np.mean(gaps < 0.06))
    assert min(shares["clear"]) > 0.97
    for kind in ("occluded", "truncated"):
        assert 0.15 < min(shares[kind]) < 0.6
        assert 0.6 < max(shares[kind]) < 0.97


def test_several_stations_see_more_and_one_of_them_is_the_eye(ball, complete):
    view = drawn("stations", ball, complete, 0)
    toward = view.points @ view.eye / np.linalg.norm(view.eye)
    assert toward.min() < -0.1
    state, _ = look_up(view.visibility, view.points)
    assert 0.5 < np.mean(state == SURFACE) <= 1


def test_kinds_are_drawn_as_often_as_their_weights_say():
    rng = np.random.default_rng(0)
    weights = {"clear": 3.0, "rings": 1.0, "noisy": 0.0}
    found = [draw_kind(rng, weights) for _ in range(400)]
    assert set(found) == {"clear", "rings"}
    assert np.mean(np.array(found) == "rings") == pytest.approx(0.25, abs=0.07)
    assert sum(MIXTURE.values()) == pytest.approx(1)
    assert {draw_kind(rng) for _ in range(600)} == set(MIXTURE)
