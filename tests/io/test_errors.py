"""The one line that a user reads."""

import json
import pathlib
import pickle
import sys

import pytest

from prism_jax.io.errors import InputError, require


def test_is_one_printable_line_and_comes_through_from_another_process():
    error = InputError(pathlib.Path("a\nb\x1b[31m.ply"), "fault\r\n", "remedy")
    assert isinstance(error, ValueError)
    assert str(error) == "a b [31m.ply: fault ; remedy"
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is InputError
    assert str(again) == str(error)


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    assert require("json", "data") is json
    monkeypatch.setitem(sys.modules, "fpsample", None)
    with pytest.raises(InputError) as error:
        require("fpsample", "data")
    told = 'fpsample: not installed; install the extra: pip install "prism_jax[data]"'
    assert str(error.value) == told
