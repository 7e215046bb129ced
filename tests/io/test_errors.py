"""The one line that a user reads."""

import pathlib
import pickle

from prism_jax.io.errors import InputError


def test_names_subject_fault_and_remedy():
    error = InputError(pathlib.Path("a.ply"), "is empty", "write it again")
    assert str(error) == "a.ply: is empty; write it again"
    assert isinstance(error, ValueError)


def test_it_comes_through_from_another_process():
    error = InputError(pathlib.Path("a.ply"), "is empty", "write it again")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is InputError
    assert str(again) == str(error)


def test_is_one_printable_line_whatever_the_file_is_called():
    error = InputError("a\nb\x1b[31m.ply", "fault\r\n", "remedy")
    assert str(error).isprintable()
    assert str(error) == "a b [31m.ply: fault ; remedy"
