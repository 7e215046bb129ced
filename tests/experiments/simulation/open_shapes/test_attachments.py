import numpy as np
import pytest

from experiments.simulation.open_shapes.attachments import (
    cut_out,
    is_mirrored,
    legs,
    mirrored,
    pedestal,
    plinth,
    set_onto,
    symmetry,
    touched,
)
from experiments.simulation.solids import ball, box, rod, torus, union

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def body():
    return box((0, 0, 0), (1, 1, 1))


def test_a_line_touches_a_solid_where_it_enters():
    ball_of_two = ball((0, 0, 1), 2.0, 200)
    hit = touched(ball_of_two, np.array([0.0, 0.0, 5.0]), -UP)
    assert hit is not None
    np.testing.assert_allclose(hit.point, (0, 0, 3), atol=1e-3)
    assert hit.normal @ UP > 0.99
    assert hit.depth == pytest.approx(4, abs=2e-3)
    assert touched(torus(1.0, 0.2), np.zeros(3), UP) is None


def test_symmetries_are_groups():
    """Any two of a symmetry's matrices make another of them."""
    for seed in range(20):
        group = symmetry(np.random.default_rng(seed))
        np.testing.assert_array_equal(group[0], np.eye(3))
        for first in group:
            np.testing.assert_allclose(first @ first.T, np.eye(3), atol=1e-12)
            for second in group:
                gaps = [np.abs(first @ second - other).max() for other in group]
                assert min(gaps) < 1e-9


def test_a_mirrored_solid_is_its_right_half_twice():
    ends = rod((-0.5, 0, 0), (2, 0, 0), 0.3) + box((2, 1, 0), (1, 3, 1))
    whole = mirrored(ends)
    right = ends.trim_by_plane((1, 0, 0), 0.0)
    assert whole.volume() == pytest.approx(2 * right.volume())
    assert (whole - whole.mirror((1, 0, 0))).volume() < 1e-9
    left = box((-2, 0, 0), (1, 1, 1))
    assert mirrored(left).volume() == left.volume()
    assert is_mirrored((np.eye(3), np.diag([-1.0, 1, 1])))
    assert not is_mirrored((np.eye(3), np.diag([1.0, -1, 1])))


@pytest.mark.parametrize("is_round", [True, False])
def test_what_is_set_onto_a_symmetric_body_holds(is_round):
    """Every copy meets the body, and none is swallowed by it."""
    body = rod((0, 0, -0.5), (0, 0, 0.5), 0.6, segments=120)
    part = ball((5, 5, 5), 0.2) if is_round else box((0, 0, 0), (0.3, 0.1, 0.6))
    placed = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        for copy in set_onto(rng, body, part, symmetry(rng)):
            whole = union([body, copy])
            assert len(whole.decompose()) == 1
            assert whole.volume() > body.volume() + part.volume() / 3
            placed += 1
    assert placed > 20


def test_what_is_cut_out_of_a_body_is_missing_and_the_rest_in_one_piece(body):
    tool, cuts = box((0, 0, 0), (0.2, 0.2, 0.2)), 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        left = cut_out(rng, body, tool, symmetry(rng))
        assert 0.4 <= left.volume() <= 1 + 1e-9
        assert len(left.decompose()) == 1
        cuts += left.volume() < 0.999
    assert cuts > 15


@pytest.mark.parametrize("kind", [legs, pedestal, plinth])
def test_stands_hold_a_body_above_the_floor(body, kind):
    made = 0
    for own in (body, ball((1, 2, 3), 0.7), rod((0, 0, 0), (2, 0, 0), 0.3)):
        for seed in range(8):
            solids = kind(np.random.default_rng(seed), own)
            if solids:
                assert len(union([own, *solids]).decompose()) == 1
                assert lowest(union(solids)) < lowest(own)
            made += len(solids) > 0
    assert made > 20


def lowest(solid) -> float:
    return solid.bounding_box()[2]
