import numpy as np
import pytest
import trimesh

from experiments.simulation.contact_sheet import (
    MARGIN,
    STEEL,
    Row,
    contact_sheet,
    draw,
    open_row,
    shape_row,
)

SIZE = 48


def colored(picture: np.ndarray) -> np.ndarray:
    """Pixels of the blue surface; the floor and its shadows are grey."""
    return np.ptp(picture.astype(int), axis=2) > 8


def test_a_ball_fills_its_square_but_for_the_margin():
    picture = draw(trimesh.creation.icosphere(4), SIZE)
    share = np.pi / 4 / (1 + MARGIN) ** 2
    assert colored(picture).mean() == pytest.approx(share, abs=0.04)


def test_the_view_has_z_up_and_the_light_from_above():
    """Seen from almost level, the lit top of a tall box is above its front."""
    tower = trimesh.creation.box((1, 1, 2))
    picture = draw(tower, SIZE, STEEL, (0.0, 1.0, 0.5)).astype(int)
    rows = np.flatnonzero(colored(picture)[:, SIZE // 2])
    top, front = picture[rows[2], SIZE // 2], picture[rows[-3], SIZE // 2]
    assert top.sum() > 1.2 * front.sum()


def test_winding_does_not_show():
    box = trimesh.creation.box((1, 2, 1))
    inverted = box.copy()
    inverted.invert()
    np.testing.assert_array_equal(draw(box, SIZE), draw(inverted, SIZE))


def test_shadows_fall_on_the_floor_away_from_the_light():
    picture = draw(trimesh.creation.box((1, 1, 1)), SIZE).astype(int)
    floor = np.where(colored(picture), 255, picture.mean(axis=2))
    left, right = (floor[SIZE // 2 :, half] for half in (slice(12), slice(-12, None)))
    assert left.min() > 210
    assert np.mean(right < 210) > 0.05


def test_what_is_drawn_is_seen_from_the_viewer():
    """The same box, seen along its long side and along its short one."""
    plank = trimesh.creation.box((4, 0.5, 1))
    wide, narrow = (
        np.flatnonzero(colored(draw(plank, SIZE, STEEL, eye)).any(axis=0)).size
        for eye in ((0.0, 1.0, 0.1), (1.0, 0.0, 0.1))
    )
    assert wide > 1.5 * narrow


def test_sheet_places_rows_side_by_side():
    tiles = [np.full((10, 10, 3), shade, np.uint8) for shade in (10, 80, 160)]
    rows = [Row("a", tiles[:2]), Row("b", tiles[2:]), Row("c", tiles[:1])]
    sheet = np.asarray(contact_sheet(rows, 2, label_height=12))
    assert sheet.shape == (2 * 22, 2 * 20 + 1, 3)
    assert np.all(sheet[12:22, 10:20] == 80)
    assert np.all(sheet[12:22, 21:31] == 160)
    assert np.all(sheet[34:44, :10] == 10)
    assert np.all(sheet[34:44, 21:] == 255)
    assert sheet[:12, :20].min() < 128


def test_a_row_holds_its_seeds_and_tells_categories_never_trained_on_apart():
    row = shape_row("pipe_run", (3, 4), 16)
    assert row.label == "pipe run"
    assert len(row.pictures) == 2
    assert not np.array_equal(*row.pictures)
    for name in ("bench", "tank"):
        amber = shape_row(name, (3,), 16).pictures[0].astype(int)
        assert (amber[..., 0] - amber[..., 2]).max() > 40


def test_a_row_of_open_shapes_has_one_of_each_seed():
    row = open_row(range(3, 6), 16)
    assert row.label == "3 to 5"
    assert len({picture.tobytes() for picture in row.pictures}) == 3


def test_pictures_of_several_sizes_are_refused():
    rows = [Row("a", [np.zeros((n, n, 3), np.uint8) for n in (8, 9)])]
    with pytest.raises(ValueError, match="one size"):
        contact_sheet(rows)
    with pytest.raises(ValueError, match="one size"):
        contact_sheet([])
