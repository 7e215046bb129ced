"""Examples to look at: which ones, and that they show what is scored."""

import re

import numpy as np
import pytest

from experiments.assets import CELLS
from experiments.gallery_page import (
    COLUMNS,
    DISTANCE_COLORS,
    FAR,
    complete_items,
    distance_colors,
    gallery_page,
    picture_row,
)
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation.protocol import Protocol
from prism_jax.evaluation.run import Predictions, evaluate

PROTOCOL = Protocol(64, 1.4, with_emd=False)


def moved(partials, eyes):
    return Predictions(partials + np.float32([0.3, 0.0, 0.2]))


@pytest.fixture(scope="module")
def shown():
    return complete_items(moved, RecordedCells(CELLS), [0, 3], PROTOCOL)


def test_numbers_are_those_of_the_evaluation(shown):
    scores = evaluate(moved, RecordedCells(CELLS), PROTOCOL)["per_example"]
    for item, index in zip(shown, (0, 3), strict=True):
        for name, value in (("partial", item.before), ("completed", item.after)):
            expected = scores["clouds"][name]["cd_l2"][index]
            assert value == pytest.approx(expected, 1e-5)
        kind, name = scores["category"][index], scores["name"][index]
        assert item.name == f"{kind} {name}"
        assert f"completed {1e4 * item.after:.4g}" in item.label


def test_errors_are_distances_to_the_ground_truth(shown):
    item = shown[0]
    cloud = np.concatenate([item.measured, item.added])
    assert len(item.errors) == len(cloud)
    for row in (0, len(item.measured), -1):
        apart = np.linalg.norm(item.complete - cloud[row], axis=1).min()
        assert item.errors[row] == pytest.approx(apart)


def test_pictures_show_their_clouds(shown):
    row = picture_row(shown[0], 48)
    assert len(row.pictures) == len(COLUMNS)
    partial, completed, truth, errors = row.pictures
    assert all(picture.shape == (48, 48, 3) for picture in row.pictures)
    blue = lambda p: (p[..., 2].astype(int) - p[..., 0] > 60).sum()  # noqa: E731
    orange = lambda p: (p[..., 0].astype(int) - p[..., 2] > 60).sum()  # noqa: E731
    assert blue(partial) and not orange(partial)
    assert orange(completed)
    assert not blue(truth) and not orange(truth) and (truth < 255).any()
    assert (errors < 255).any()


def test_page_has_every_example_and_needs_no_network(shown):
    page = gallery_page(shown, "small <on> cells").replace("\\u002f", "/")
    for number, item in enumerate(shown, start=1):
        assert f"{number}. {item.label}" in page
    assert "small &lt;on&gt; cells" in page
    assert not re.search(r"<(script|link)[^>]*(src|href)=", page)
    assert page.count('"visible":false') >= len(COLUMNS)


def test_colours_run_from_near_to_far():
    colors = distance_colors(np.array([0.0, FAR, 2 * FAR, FAR * DISTANCE_COLORS[1][0]]))
    first, second, *_, last = (color for _, color in DISTANCE_COLORS)
    np.testing.assert_allclose(colors, [first, last, last, second])
