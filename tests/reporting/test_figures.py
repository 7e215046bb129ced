"""What the figures show."""

import numpy as np
import pytest

from prism_jax.reporting.figures import (
    MAX_SHOWN_POINTS,
    PAGE_ASPECT,
    Cloud,
    Panel,
    clouds_figure,
    depth_figure,
    losses_figure,
)

POINTS = np.random.default_rng(0).normal(size=(20_000, 3))
UP = np.array([0.0, 0.0, 1.0])


def test_panels_share_one_scale_and_one_view():
    small, large = Cloud("a", POINTS[:50] / 10, "red"), Cloud("b", POINTS, "blue")
    panels = [Panel("A", [small]), Panel("B", [small, large])]
    figure = clouds_figure(panels, np.array([1.0, 0, 0]), UP)
    first, second = figure.layout.scene, figure.layout.scene2
    for axis, column in zip("xyz", POINTS.T, strict=True):
        span = first[f"{axis}axis"].range
        assert span == second[f"{axis}axis"].range
        assert span[0] <= column.min() <= column.max() <= span[1]
    sides = [np.ptp(first[f"{axis}axis"].range) for axis in "xyz"]
    ratio = [first.aspectratio[axis] for axis in "xyz"]
    np.testing.assert_allclose(np.divide(ratio, sides), ratio[0] / sides[0])
    assert first.camera == second.camera
    bounds = np.array([[-1.0, -2, -3], [1, 2, 3]])
    scene = clouds_figure(panels, np.array([1.0, 0, 0]), UP, bounds).layout.scene
    spans = [scene[f"{axis}axis"].range for axis in "xyz"]
    np.testing.assert_allclose(np.transpose(spans), 1.06 * bounds)


@pytest.mark.parametrize("up", [UP, np.array([0.0, -0.8, -0.6])])
@pytest.mark.parametrize("sides", [[9, 1, 1], [0, 5, 5]])
def test_every_box_is_within_the_view(up, sides):
    """Through the same perspective as Plotly's: 45 degrees from top to bottom."""
    bounds = np.array([[0.0, 0, 0], sides])
    toward = np.array([0.6, -0.64, 0.48])
    toward = toward - (toward @ up - 0.3) * up
    toward /= np.linalg.norm(toward)
    cloud = Cloud("a", bounds, "red")
    scene = clouds_figure([Panel("A", [cloud])] * 2, toward, up).layout.scene
    eye, center = (
        [v[a] for a in "xyz"] for v in (scene.camera.eye, scene.camera.center)
    )
    ratio = np.array([scene.aspectratio[axis] for axis in "xyz"])
    corners = ratio * (np.mgrid[:2, :2, :2].reshape(3, -1).T - 0.5)
    forward = np.subtract(center, eye) / np.linalg.norm(np.subtract(center, eye))
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    along = (corners - eye) @ forward
    assert (along > 0).all()
    high = (corners - eye) @ np.cross(right, forward) / along / np.tan(np.pi / 8)
    wide = (corners - eye) @ right / along / np.tan(np.pi / 8)
    assert np.abs(high).max() < 1 and np.abs(wide).max() < PAGE_ASPECT / 2
    assert max(np.abs(high).max(), np.abs(wide).max() / (PAGE_ASPECT / 2)) > 0.6


def test_far_from_the_origin_the_axes_say_what_was_taken_off():
    """In float32 these points would be half a metre apart."""
    offset = np.array([500_123.0, 5_400_321.0, 12.0])
    cloud = Cloud("a", POINTS[:50] + offset, "red")
    figure = clouds_figure([Panel("A", [cloud])], UP[[2, 1, 0]], UP)
    for i, axis in enumerate("xyz"):
        shown = np.asarray(figure.data[0][axis], np.float64)
        low, high = figure.layout.scene[f"{axis}axis"].range
        assert low <= shown.min() <= shown.max() <= high
        title = figure.layout.scene[f"{axis}axis"].title.text
        name, _, less = title.replace(",", "").partition(" - ")
        assert name == axis and bool(less) == (axis != "z")
        shown += float(less or 0)
        np.testing.assert_allclose(shown, cloud.points[:, i], rtol=0, atol=1e-5)


def test_clouds_of_any_size_are_shown_and_large_ones_thinned():
    sizes = {"a": POINTS[:50], "b": POINTS, "c": POINTS[:1], "d": POINTS[:0]}
    clouds = [Cloud(name, points, "red") for name, points in sizes.items()]
    panels = [Panel("A", clouds), Panel("B", clouds[:1])]
    figure = clouds_figure(panels, UP[[2, 1, 0]], UP)
    np.testing.assert_array_equal(figure.data[0].x, POINTS[:50, 0].astype(np.float32))
    counts = [len(trace.x) for trace in figure.data]
    assert counts == [50, MAX_SHOWN_POINTS, 1, 0, 50]
    kept = np.flatnonzero(np.isin(POINTS[:, 0].astype("f4"), figure.data[1].x))
    assert abs(np.median(kept) / len(POINTS) - 0.5) < 0.1
    # A name is in the legend once.
    assert [trace.showlegend for trace in figure.data] == [True] * 4 + [False]


def test_depth_is_missing_outside_the_mask_and_every_loss_has_its_axes():
    depth = np.full((4, 5), 2.0, np.float32)
    mask = np.arange(20).reshape(4, 5) > 7
    figure = depth_figure(("a", "b"), [depth, depth], [mask, ~mask])
    np.testing.assert_array_equal(np.isnan(figure.data[0].z), ~mask)
    np.testing.assert_array_equal(np.isnan(figure.data[1].z), mask)
    assert figure.data[0].coloraxis == figure.data[1].coloraxis
    losses = {"objective": [0.5, 0.4], "normal": [0.1, 0.2]}
    figure = losses_figure(losses)
    assert [list(trace.y) for trace in figure.data] == list(losses.values())
    assert len({trace.yaxis for trace in figure.data}) == 2
