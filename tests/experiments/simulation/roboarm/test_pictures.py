import numpy as np
import pytest

from experiments.simulation.contact_sheet import GROUND_TRUTH, OBSERVED, draw_clouds
from experiments.simulation.roboarm.pictures import (
    COLORS,
    draw_depth,
    draw_scene,
    frame_row,
)
from experiments.simulation.roboarm.sequences import make_frame, make_sequence
from prism_jax.data.recordings import LABELS


@pytest.fixture(scope="module")
def pictured(model, small):
    sequence = make_sequence(model, 2, small, np.random.default_rng(4))
    return sequence, make_frame(sequence, 0, small, np.random.default_rng(0))


def test_a_row_is_four_square_pictures(pictured):
    row = frame_row(*pictured[:1], 0, pictured[1], 48)
    assert "boxes" in row.label and "% hidden" in row.label
    assert [picture.shape for picture in row.pictures] == [(48, 48, 3)] * 4
    for picture in row.pictures:
        assert np.ptp(picture) > 50


def test_the_camera_picture_shows_the_robot_where_the_labels_say(pictured):
    sequence, frame = pictured
    picture = draw_scene(sequence, 0, sequence.cell.camera).astype(float)
    hue = picture / np.maximum(np.linalg.norm(picture, axis=-1, keepdims=True), 1)
    color = np.array(COLORS["robot"]) / np.linalg.norm(COLORS["robot"])
    found = hue @ color > 0.9995
    np.testing.assert_array_equal(found, frame.labels == LABELS["robot"])


def test_depth_runs_from_violet_to_red_and_no_return_is_black():
    depth = np.tile(np.linspace(1, 2, 50), (4, 1))
    depth[0] = 0
    picture = draw_depth(depth)
    assert (picture[0] == 0).all()
    assert picture[1, 0, 2] > picture[1, 0, 0] and picture[1, -1, 0] > 200


def test_later_clouds_lie_over_earlier_ones(pictured):
    camera = pictured[0].cell.camera
    middle = np.asarray(camera.position) + camera.rotation[2]
    points = middle + np.array([[0, 0, 0], [0, 0, 1e-3]])
    blue, amber = (points, OBSERVED), (points, GROUND_TRUTH)
    for last, clouds in ((OBSERVED, [amber, blue]), (GROUND_TRUTH, [blue, amber])):
        picture = draw_clouds(clouds, camera)
        painted = picture[(picture < 255).any(axis=-1)]
        assert len(painted) in (4, 6)
        assert (painted <= np.ceil(255 * np.array(last))).all()
        assert np.argmax(painted.sum(axis=0)) == np.argmax(last)
