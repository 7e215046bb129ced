"""HDF5 files and their handles."""

import os

import h5py
import numpy as np
import pytest

from prism_jax.data.public import hdf5
from prism_jax.io import InputError


def test_a_process_opens_a_file_once_and_another_one_for_itself(tmp_path, write):
    path = write(tmp_path / "a.h5", {"data": np.arange(6.0)})
    with hdf5.opened(path, keep=True) as first:
        pass
    with hdf5.opened(str(path), keep=True) as again, hdf5.opened(path) as brief:
        assert again is first
        assert brief is not first
    assert first
    assert not brief
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "getpid", lambda: -1)
        with hdf5.opened(path, keep=True) as other:
            assert other is not first


def test_an_array_that_claims_to_be_huge_is_not_read(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("data", (2**40, 3), "f4", chunks=(2**10, 3))
    with pytest.raises(InputError, match=r"a.h5: has an array 'data' of shape"):
        hdf5.read_array(path, "data")


def test_a_group_an_empty_array_and_other_files_are_refused(tmp_path, write):
    path = write(tmp_path / "a.h5", {"data/inner": np.arange(6.0)})
    with pytest.raises(InputError, match=r"a.h5: has no array 'data': it holds data"):
        hdf5.read_array(path, "data")
    path = write(tmp_path / "b.h5", {"data": h5py.Empty("f")})
    with pytest.raises(InputError, match="no array 'data'"):
        hdf5.read_array(path, "data")
    (tmp_path / "c.h5").write_text("no HDF5")
    with pytest.raises(InputError, match=r"c.h5: cannot be read as HDF5"):
        hdf5.read_array(tmp_path / "c.h5", "data")


@pytest.mark.parametrize("link", [h5py.ExternalLink("b.h5", "/data"), None])
def test_links_are_not_followed(tmp_path, write, link):
    """Neither to another file nor, over a soft link, to one that leads there."""
    write(tmp_path / "b.h5", {"data": np.arange(6.0)})
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["outside"] = h5py.ExternalLink("b.h5", "/data")
        file["data"] = link or h5py.SoftLink("/outside")
        assert file["data"].shape == (6,)
    with pytest.raises(InputError, match=r"a.h5: has a link in place of .*'data'"):
        hdf5.read_array(path, "data")


def test_bytes_of_other_files_are_not_read(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(np.arange(6.0).tobytes())
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        storage = [(str(secret), 0, secret.stat().st_size)]
        file.create_dataset("data", (6,), "f8", external=storage)
    with pytest.raises(InputError, match=r"a.h5: keeps the array 'data' in other"):
        hdf5.read_array(path, "data")


def test_nor_those_of_virtual_arrays(tmp_path, write):
    other = write(tmp_path / "b.h5", {"data": np.arange(6.0)})
    layout = h5py.VirtualLayout((6,), "f8")
    layout[:] = h5py.VirtualSource(other, "data", (6,))
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("data", layout)
        assert file["data"][5] == 5
    with pytest.raises(InputError, match=r"a.h5: keeps the array 'data' in other"):
        hdf5.read_array(path, "data")
