import hashlib

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation import views as examples
from experiments.simulation.kinds import MIXTURE
from experiments.simulation.partials import PARTIALS
from experiments.simulation.views import QUANTUM, make_views, rounded
from prism_jax.geometry.visibility import SURFACE, look_up

DIGESTS = {
    "self_occlusion": ("09c9225232f6020f", "108d309cf279751e"),
    "crop": ("ff352f580ca0af21", "ca179be9d3ecf8ed"),
    "l515": ("f3c60a0ff936ea31", "0e17ba65cf4c3130"),
    "ouster": ("956d707e5b8d74e2", "fbebece33aac498f"),
    "sparse": ("862871da1e103970", "724f79922eb6e2f9"),
}
"""Of the arrays of two views of a mug and of a pipe run, before other kinds came."""


@pytest.fixture(scope="module")
def shape():
    return make_views("mug", 11, 2)


def test_complete_cloud_fills_the_oracle_frame(shape):
    complete = shape[1]
    assert complete.shape == (16384, 3)
    lower, upper = complete.min(axis=0), complete.max(axis=0)
    np.testing.assert_allclose(lower + upper, 0, atol=2 * QUANTUM)
    assert (upper - lower).max() == pytest.approx(2, abs=2 * QUANTUM)


def test_partials_lie_on_the_complete_surface(shape):
    partials, complete = shape[:2]
    assert partials.shape == (2, 2048, 3)
    for partial in partials:
        gaps, _ = KDTree(complete).query(partial)
        assert gaps.max() < 0.06


def test_views_see_a_side_each_from_outside(shape):
    partials, complete, eyes = shape[:3]
    hidden = []
    for partial, eye in zip(partials, eyes, strict=True):
        gaps, _ = KDTree(partial).query(complete)
        hidden.append(gaps > 0.1)
        assert 0.2 < np.mean(hidden[-1]) < 0.9
        assert 2.5 <= np.linalg.norm(eye) <= 4.0
    assert np.mean(hidden[0] != hidden[1]) > 0.1


def test_fewer_views_are_a_prefix(shape):
    partials, complete, eyes = make_views("mug", 11)[:3]
    np.testing.assert_array_equal(partials, shape[0][:1])
    np.testing.assert_array_equal(complete, shape[1])
    np.testing.assert_array_equal(eyes, shape[2][:1])


def test_clouds_are_in_farthest_point_order(shape):
    """Distances to the nearest of all points before shrink, up to the quantum."""
    for cloud in (shape[0][1], shape[1]):
        points = cloud[:300].astype(np.float64)
        gaps = [
            KDTree(points[:count]).query(points[count])[0] for count in range(1, 300)
        ]
        assert np.diff(gaps).max() <= 4 * QUANTUM


def test_a_view_of_too_few_points_is_drawn_again(shape, monkeypatch):
    make, drawn = examples.make_view, []

    def meagre_at_first(*arguments):
        view = make(*arguments)
        drawn.append(view.eye)
        return view._replace(points=view.points[:15]) if len(drawn) < 3 else view

    monkeypatch.setattr(examples, "make_view", meagre_at_first)
    eyes = make_views("mug", 11).eyes
    np.testing.assert_array_equal(eyes[0], drawn[2].astype(np.float32))
    monkeypatch.setattr(examples, "MAX_DRAWS", 2)
    drawn.clear()
    with pytest.raises(ValueError, match="no self_occlusion view of 16 points in 2"):
        make_views("mug", 11)


@pytest.mark.parametrize("kind", PARTIALS)
def test_old_kinds_are_bit_for_bit_what_they_were(kind):
    found = []
    for category, seed in (("mug", 3), ("pipe_run", 2**40 + 7)):
        made = make_views(category, seed, 2, kind)
        data = b"".join(np.ascontiguousarray(array).tobytes() for array in made[:3])
        found.append(hashlib.sha256(data).hexdigest()[:16])
        assert made.kinds == (kind, kind)
        assert made.visibilities == (None, None)
    assert tuple(found) == DIGESTS[kind]


def test_a_mixture_has_many_kinds_and_every_view_a_map():
    """Which fits the points that are stored; and fewer views are a prefix."""
    made = make_views("gearbox", 5, 12, "mixed")
    assert len(set(made.kinds)) > 4 and set(made.kinds) <= set(MIXTURE)
    for kind, partial, visibility in zip(
        made.kinds, made.partials, made.visibilities, strict=True
    ):
        assert visibility is not None
        state, behind = look_up(visibility, partial)
        assert np.mean(state == SURFACE) > (0.95 if "stations" in kind else 0.995)
        if "stations" not in kind:
            # Points are rounded, which can move them into the next pixel.
            assert np.quantile(behind[state == SURFACE], 0.01) > -QUANTUM
    fewer = make_views("gearbox", 5, 3, "mixed")
    np.testing.assert_array_equal(fewer.partials, made.partials[:3])
    assert fewer.kinds == made.kinds[:3]
    for one, other in zip(fewer.visibilities, made.visibilities, strict=False):
        assert one is not None and other is not None
        np.testing.assert_array_equal(one.state, other.state)
        np.testing.assert_array_equal(one.depth, other.depth)


def test_coordinates_are_rounded_to_the_nearest_step_and_overflow_is_refused():
    points = np.random.default_rng(0).uniform(-1.9, 1.9, (100, 3))
    exact = rounded(points)
    assert np.abs(exact - points).max() <= QUANTUM / 2 * 1.001
    assert np.all(exact.astype(np.float64) / QUANTUM % 1 == 0)
    np.testing.assert_array_equal(rounded(exact), exact)
    for bad in (2.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="within"):
            rounded(np.array([[0.0, bad, 0.0]]))
