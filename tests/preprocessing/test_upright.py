"""Which direction is up, and the turn that takes it to z."""

import numpy as np
import pytest

from prism_jax.io.errors import InputError
from prism_jax.preprocessing.upright import UP_AXES, parse_up, upright

AXES = {
    f"{sign}{axis}": float(f"{sign}1") * np.eye(3)["xyz".index(axis)]
    for sign in ("", "-")
    for axis in "xyz"
}


def test_a_vector_along_an_axis_is_the_axis():
    for up in UP_AXES:
        named = np.eye(3) if up == "z" else upright(up)
        assert np.array_equal(named @ AXES[up], [0, 0, 1]) and np.linalg.det(named) == 1
        np.testing.assert_allclose(upright(2.5 * AXES[up]), named, atol=0)


def test_any_vector_is_taken_to_z_by_the_smallest_turn():
    rng = np.random.default_rng(0)
    for up in [*rng.normal(size=(50, 3)), [1e-9, 0, -1], [0, -1e-200, 3], [1e200] * 3]:
        turn = upright(up)
        unit = np.asarray(up) / np.abs(up).max()
        unit /= np.linalg.norm(unit)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(turn @ unit, [0, 0, 1], atol=1e-15)
        assert np.linalg.det(turn) > 0
        # The angle of the turn is that between the vector and z.
        assert np.trace(turn) == pytest.approx(1 + 2 * unit[2], abs=1e-12)


def test_texts_and_what_is_no_direction():
    assert upright("z") is None
    for up in ([0, 0, 0], [0, np.nan, 1], [np.inf, 0, 0], [1, 2], "w", "auto"):
        with pytest.raises(InputError, match="use one of x, y, z"):
            upright(up)
    assert parse_up("-y") == "-y"
    assert parse_up("auto") == "auto"
    np.testing.assert_allclose(parse_up("0,-8, 6e0"), [0, -0.8, 0.6])
    for text, fault in [
        ("up", "cannot read 'up'"),
        ("", "cannot read ''"),
        ("1,2", "cannot read"),
        ("0,nan,1", "cannot read"),
    ]:
        with pytest.raises(InputError, match=f"^--up: .*{fault}.*; use one of .*auto$"):
            parse_up(text)
