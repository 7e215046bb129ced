"""Lists, folders and clouds of published sets."""

import numpy as np
import pytest

from prism_jax.data.public import layout
from prism_jax.io import InputError

ENTRY = {"taxonomy_id": "02691156", "taxonomy_name": "airplane", "test": ["a", "b"]}


def test_a_list_is_read_in_its_order_without_blank_lines(tmp_path, write):
    path = write(tmp_path / "a.list", "b/2\n\n a/1 \r\n")
    assert layout.read_list(path, r"(\w)/(\d)", "a pair") == [("b", "2"), ("a", "1")]
    path = write(tmp_path / "l.json", [ENTRY, ENTRY | {"test": ["c"], "train": []}])
    models = layout.read_json_list(path, "test")
    assert models == [("airplane", "02691156", name) for name in "abc"]


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\n \n", "no objects listed"),
        (b"a/1\n../secret\n", "invalid line '../secret', expected a pair"),
        (b"a/1\nb/2\na/1\n", "duplicate object"),
        (b"\xff\xfe\x00", "not a text file"),
    ],
)
def test_an_unsound_list_is_refused(tmp_path, content, fault):
    path = tmp_path / "a.list"
    path.write_bytes(content)
    with pytest.raises(InputError, match=fault):
        layout.read_list(path, r"(\w)/(\d)", "a pair")


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ({"taxonomy_id": "x"}, "ids of split 'test'"),
        ([ENTRY | {"test": [1]}], "ids of split 'test'"),
        ([ENTRY | {"test": ["../../x"]}], "ids of split 'test'"),
        ([ENTRY | {"taxonomy_id": ".."}], "ids of split 'test'"),
        ([ENTRY | {"test": []}], "no objects listed"),
    ],
)
def test_json_of_another_form_is_refused(tmp_path, write, content, fault):
    path = write(tmp_path / "l.json", content)
    with pytest.raises(InputError, match=fault):
        layout.read_json_list(path, "test")


def test_missing_files_are_counted_and_the_first_named(tmp_path, write):
    write(tmp_path / "a" / "1.txt", "x")
    wanted = {"a": ["1.txt", "2.txt", "3.txt"], "b": ["1.txt", "2.txt"]}
    with pytest.raises(InputError) as error:
        layout.require_files(tmp_path, wanted, "the list", "a/<n>.txt")
    assert str(error.value) == (
        f"{tmp_path}: 4 of the 5 files in the list are missing: "
        "a/2.txt, a/3.txt, b/1.txt, ...; copy the whole data set here, as a/<n>.txt"
    )
    layout.require_files(tmp_path, {"a": ["1.txt"]}, "the list", "a/<n>.txt")


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (np.zeros((0, 3)), "is not a cloud"),
        (np.zeros((4, 4)), "is not a cloud"),
        (np.zeros((4, 3), "S3"), "is not a cloud"),
        (np.full((4, 3), 1e300), "not finite"),
        (np.zeros((5, 3)), "5 points instead of 4"),
    ],
)
def test_an_unsound_cloud_is_refused(points, fault):
    with pytest.raises(InputError, match=rf"^file\.npy: .*{fault}"):
        layout.sound_cloud(points, "file.npy", 4)


def test_items_walk_through_the_views_of_each_model(tmp_path):
    models = [layout.Model("b", "x", "1"), layout.Model("a", "y", "2")]
    source = layout.ListedSource(tmp_path, models, views=3)
    assert source.categories == ("a", "b")
    found = [source.locate(index) for index in range(len(source))]
    assert found == [(model, view) for model in models for view in range(3)]
    assert source.locate(-1) == found[-1]
    with pytest.raises(IndexError):
        source.locate(6)
