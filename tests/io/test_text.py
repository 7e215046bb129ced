"""Lines of numbers."""

import re

import numpy as np
import pytest

from prism_jax.io import InputError
from prism_jax.io.clouds import read_cloud
from prism_jax.io.text import read_text

EXPECTED = [[1.0, 2.0, 3.0], [4.5, -5e-3, 6.0]]
TABLES = {
    "blanks": "1 2 3\n4.5 -5e-3 6\n",
    "tabs and trailing blanks": "1\t2\t 3 \n 4.5\t-5e-3\t6\t\n",
    "commas": "1,2,3\n4.5,-5e-3,6\n",
    "semicolons": "1;2;3\n4.5;-5e-3;6\n",
    "header in another order": 'i,"Z",Y,X\n0,3,2,1\n0,6,-5e-3,4.5\n',
    "header of other names": "east north up\n1 2 3\n4.5 -5e-3 6\n",
    "comments": "# a scan\n//X Y Z\n\n1 2 3\n\n# half\n4.5 -5e-3 6\n",
    "comment that names the columns": "# today\n# t, x, y, z\n9,1,2,3\n9,4.5,-5e-3,6",
    "CloudCompare": "//Z Y X I\n3 2 1 0\n6 -5e-3 4.5 0\n",
    "comment of as many words": "# by somebody of today\n1 2 3 4\n4.5 -5e-3 6 4\n",
    "tabs, with blanks in names": "Point ID\tX\tY\tZ\n9\t1\t2\t3\n9\t4.5\t-5e-3\t6\n",
    "numbered names": "t\tx1 (m)\ty1 (m)\tz1 (m)\n9\t1\t2\t3\n9\t4.5\t-5e-3\t6\n",
    "ParaView": '"Points_m_XYZ:1","t","Points_m_XYZ:0","Points_m_XYZ:2"\n'
    "2,9,1,3\n-5e-3,9,4.5,6\n",
    "count": "2\n1 2 3 9 9\n4.5 -5e-3 6 9 9\n",
    "decimal commas": "x;y;z\n1,0;2,0;3,0\n4,5;-5,0e-3;6,0\n",
    "decimal commas and blanks": "1,0 2,0 3,0 7\n4,5 -0,005 6,0 7\n",
    "a comment in Latin letters": "# Ger\xe4t 3\n% m\n1 2 3\n4.5 -5e-3 6\n",
    "Windows": "\ufeffx y z\r\n1 2 3\r\n4.5 -5e-3 6\r\n",
}


def test_reads(tmp_path):
    for name, table in TABLES.items():
        coding = "latin-1" if "Latin" in name else "utf-8"
        for data in (table.encode(coding), table.encode("utf-16")):
            (tmp_path / "a.xyz").write_bytes(data)
            read = read_text(tmp_path / "a.xyz")
            assert read.dtype == np.float64
            np.testing.assert_array_equal(read, EXPECTED, name)


def test_other_columns_keep_names_and_values_and_what_is_left_out_is_told(tmp_path):
    table = 'Ring,"X [m]",y,z,class,red,,I (dB)\n7,1,2,3,car,9,1,.5\n8,4,5,6,,255,1,nan'
    colors = {"intensity": -9, "red": 255, "green": 0, "blue": 7}
    for name, text, expected, left_out in (
        ("a.csv", table, {"Ring": 7, "red": 9, "I": 0.5}, 2),
        ("a.xyzrgb", "1 2 3 .5 1 0\n", {"red": 0.5, "green": 1, "blue": 0}, 0),
        ("a.pts", "1\n1 2 3 -9 255 0 7\n", colors, 0),
        ("a.asc", "//X Y Z R G B\n1 2 3 255 0 7\n", dict([*colors.items()][1:]), 0),
        ("a.xyz", "1 2 3 .5 0 1\n", {}, 3),
    ):
        (tmp_path / name).write_text(text)
        points, _, notes = read_cloud(tmp_path / name, fields=(fields := {}))
        assert points[0].tolist() == [1, 2, 3]
        assert {key: column[0] for key, column in fields.items()} == expected
        assert f"; {left_out} more" in notes.get("columns", "; 0 more")
        assert name != "a.pts" or fields["red"].dtype == np.uint8


def test_numbers_come_back_bit_for_bit_and_those_that_are_not_finite_stay(tmp_path):
    points = np.random.default_rng(0).normal(size=(50, 3)) * 1e6
    np.savetxt(tmp_path / "a.csv", points, fmt="%.17g", delimiter=",")
    assert read_text(tmp_path / "a.csv").tobytes() == points.tobytes()
    (tmp_path / "a.csv").write_text("1,nan,3\n-inf,0,1e999\n")
    expected = [[1, np.nan, 3], [-np.inf, 0, np.inf]]
    np.testing.assert_array_equal(read_text(tmp_path / "a.csv"), expected)


FAULTS = [
    (b"# nothing\n\n", "no points"),
    (b"x y z\n", "ends after 0"),
    (b"row,col,a,b,c\n0,0,1,2,3\n", "header 'row,col,a,b,c' does not name x"),
    (b"".join(b"%d 1 2 3\n" % n for n in range(10)), "which are x, y and z?"),
    (b"3\n1 2 3\n4 5 6\n", "3 points announced, 2 found"),
    (b"Scan Pos X Y Z\n1 0.1 0.2 0.3\n", "X Y Z' does not name x, y and z"),
    (b"x,y,z\n1,5,2,5,3,5\n", "'x,y,z' does not name x, y and z"),
    (b"id x y z\n1 2 3 4\n1 2 3 4 5\n", "line 3 has 5 columns, not 4"),
    (b"1 2\n3 4\n", "column"),
    (b"# a\n\nx,y,z\n1,2,3\n1,,3\n", "in line 5"),
    (b"1 2 3\n1 2 0x10\n", "0x10"),
    (b"1 2 a\n1 2 3\n", "'a' to float64 in line 1"),
    ("1 2 3\n".encode("utf-16-le"), "line 2 has 1 columns, not 3"),
    (b"1,2,3\n1;2;3\n", "line 1 has 1 columns, not 3"),
]


def test_malformed_table(tmp_path):
    for data, fault in FAULTS:
        (tmp_path / "a.txt").write_bytes(data)
        with pytest.raises(InputError, match=f"{re.escape(fault)}.*one point per line"):
            read_text(tmp_path / "a.txt")
