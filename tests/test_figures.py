"""What the figures show."""

import numpy as np
import pytest

from prism_jax.figures import (
    MAX_SHOWN_POINTS,
    Cloud,
    Panel,
    clouds_figure,
    depth_figure,
    losses_figure,
    subsample,
)

POINTS = np.random.default_rng(0).normal(size=(20_000, 3))
UP = np.array([0.0, 0.0, 1.0])


def test_subsample_is_even_ordered_and_the_same_every_time():
    rows = np.arange(1000)
    chosen = subsample(rows, 100)
    assert len(chosen) == 100
    assert (np.diff(chosen) > 0).all()
    assert 400 < np.median(chosen) < 600
    np.testing.assert_array_equal(chosen, subsample(rows, 100))
    assert subsample(rows, 1000) is rows


def test_panels_share_one_scale_and_one_view():
    small, large = Cloud("a", POINTS[:50] / 10, "red"), Cloud("b", POINTS, "blue")
    panels = [Panel("A", [small]), Panel("B", [small, large])]
    figure = clouds_figure(panels, np.array([1.0, 0, 0]), UP)
    first, second = figure.layout.scene, figure.layout.scene2
    for axis in "xyz":
        span = first[f"{axis}axis"].range
        assert span == second[f"{axis}axis"].range
        column = POINTS[:, "xyz".index(axis)]
        assert span[0] <= column.min() <= column.max() <= span[1]
    sides = [np.ptp(first[f"{axis}axis"].range) for axis in "xyz"]
    ratio = [first.aspectratio[axis] for axis in "xyz"]
    np.testing.assert_allclose(np.divide(ratio, sides), ratio[0] / sides[0])
    assert first.camera == second.camera


def test_far_from_the_origin_the_axes_say_what_was_taken_off():
    """In float32 these points would be half a metre apart."""
    offset = np.array([500_123.0, 5_400_321.0, 12.0])
    cloud = Cloud("a", POINTS[:50] + offset, "red")
    figure = clouds_figure([Panel("A", [cloud])], UP[[2, 1, 0]], UP)
    scene = figure.layout.scene
    titles = [scene[f"{axis}axis"].title.text for axis in "xyz"]
    assert titles[2] == "z"
    for i, axis in enumerate("xy"):
        name, _, less = titles[i].partition(" - ")
        assert name == axis
        shown = np.asarray(figure.data[0][axis], np.float64) + float(
            less.replace(",", "")
        )
        np.testing.assert_allclose(shown, cloud.points[:, i], rtol=0, atol=1e-5)
        span = scene[f"{axis}axis"].range
        assert (
            span[0] <= min(figure.data[0][axis]) <= max(figure.data[0][axis]) <= span[1]
        )
    np.testing.assert_array_equal(figure.data[0].z, cloud.points[:, 2].astype("f4"))


def test_large_cloud_is_thinned_and_a_small_one_shown_as_it_is():
    clouds = [Cloud("a", POINTS[:50], "red"), Cloud("b", POINTS, "blue")]
    figure = clouds_figure([Panel("A", clouds)], UP[[2, 1, 0]], UP)
    np.testing.assert_array_equal(figure.data[0].x, POINTS[:50, 0].astype(np.float32))
    assert len(figure.data[1].x) == MAX_SHOWN_POINTS


def test_flat_cloud_and_one_point_have_a_box():
    for points in (POINTS[:9] * [1, 1, 0], POINTS[:1]):
        figure = clouds_figure([Panel("A", [Cloud("a", points, "red")])], UP, UP)
        assert np.isfinite(list(figure.layout.scene.zaxis.range)).all()


def test_cloud_without_a_point_is_no_error():
    clouds = [Cloud("a", POINTS[:9], "red"), Cloud("b", POINTS[:0], "blue")]
    figure = clouds_figure([Panel("A", clouds)], UP, UP)
    assert len(figure.data[1].x) == 0


def test_name_is_in_the_legend_once():
    cloud = Cloud("observed", POINTS[:9], "red")
    figure = clouds_figure([Panel("A", [cloud]), Panel("B", [cloud])], UP, UP)
    assert [trace.showlegend for trace in figure.data] == [True, False]


def test_depth_is_missing_outside_the_mask():
    depth = np.full((4, 5), 2.0, np.float32)
    mask = np.arange(20).reshape(4, 5) > 7
    figure = depth_figure(("a", "b"), [depth, depth], [mask, ~mask])
    np.testing.assert_array_equal(np.isnan(figure.data[0].z), ~mask)
    np.testing.assert_array_equal(np.isnan(figure.data[1].z), mask)
    assert figure.data[0].coloraxis == figure.data[1].coloraxis


@pytest.mark.parametrize("steps", [1, 4])
def test_every_loss_has_its_axes(steps):
    losses = {"objective": [0.5] * steps, "normal": [0.1] * steps}
    figure = losses_figure(losses)
    assert [list(trace.y) for trace in figure.data] == list(losses.values())
    assert len({trace.yaxis for trace in figure.data}) == 2
