"""Packed sources: what comes back, whole shards, and several sources together."""

import json
import pickle

import numpy as np
import pytest

from experiments.assets import CELLS
from experiments.simulation.packing import PackConfig, pack
from prism_jax.data.manifest import hash_files
from prism_jax.data.pipeline import Framing, frame_example
from prism_jax.data.recordings import RecordedCells
from prism_jax.data.shards import Shards
from prism_jax.data.source import Example, Source
from prism_jax.geometry.visibility import SURFACE, nothing_known
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from tests.io.test_arrays import npy

CONFIG = PackConfig(num_partial=64, num_complete=128)


class Balls:
    """Ordered clouds of any place and size, some without a known sensor."""

    categories = ("ball", "egg")

    def __init__(self, count=5, **changes):
        self.count, self.objects, self.changes = count, np.arange(count), changes

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        rng = np.random.default_rng(range(self.count)[index])
        cloud = rng.normal(size=(200, 3)) * 10.0**index + 100 * index
        cloud = cloud.astype(np.float32)
        eye = None if index % 2 else np.float32([index, 2, 3])
        category = self.categories[index % 2]
        made = Example(cloud, cloud[:90], eye, category, f"{index}", ordered=True)
        return made._replace(**self.changes)


def packed(folder, config=CONFIG, **sources):
    return Shards(pack(sources, folder, config, num_workers=0, progress=False))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    cells = RecordedCells(CELLS)
    return packed(tmp_path_factory.mktemp("a") / "train", balls=Balls(), cells=cells)


def test_clouds_come_back_to_half_a_step(source):
    assert isinstance(source, Source)
    for index in range(5):
        given, found = Balls()[index], source[index]
        side = np.ptp(given.complete, axis=0).max()
        for cloud, whole in (
            (found.partial, given.partial[:64]),
            (found.complete, given.complete[:128]),
        ):
            assert cloud.dtype == np.float32
            # Half a step, and the rounding of single precision far from the origin.
            bound = 0.51 * side / 65535 + 2e-7 * np.abs(whole).max()
            assert np.abs(cloud - whole).max() <= bound
        assert (found.category, found.name) == (given.category, f"balls/{index}")
        assert found.ordered and not found.any_heading
        np.testing.assert_array_equal(found.eye, given.eye)


def test_sources_stand_one_after_the_other_and_are_ordered(source):
    """Framed for a training they are what they were, to a step."""
    cells = RecordedCells(CELLS)
    assert len(source) == 5 + 12
    assert set(source.categories) == {"ball", "egg", *cells.categories}
    assert source[5].name == f"cells/{cells[0].name}" and source[5].any_heading
    with pytest.raises(IndexError):
        source[17]
    examples = cells[3], pickle.loads(pickle.dumps(source))[5 + 3]
    given, found = (frame_example(e, Framing(32, 64, 1.4)) for e in examples)
    half, own = (
        float(Workspace.from_points(e.partial, 1.4).half_extent) for e in examples
    )
    assert own == pytest.approx(half, rel=0.05)
    partial = found.partial * own
    center = (given.partial * half)[0] - partial[0]
    np.testing.assert_allclose(partial + center, given.partial * half, atol=1e-3 * half)


def test_maps_are_carried_on_and_where_there_are_none_nothing_is_known(tmp_path):
    """Packed with others, and packed again."""
    known = nothing_known()
    known.state[1, 3], known.depth[1, 3] = SURFACE, 2.5
    once = packed(tmp_path / "a", balls=Balls(2), maps=Balls(3, visibility=known))
    for source in (once, packed(tmp_path / "b", again=once)):
        for index in range(5):
            expected = nothing_known() if index < 2 else known
            found = source[index].visibility
            np.testing.assert_array_equal(found.state, expected.state)
            np.testing.assert_array_equal(found.depth, expected.depth)


VIEWS = np.array([[0, 0], [1, 1]], np.int32)
DAMAGED = {
    "views.npy": (VIEWS - 1, VIEWS.astype(float), VIEWS[:0]),
    "box.npy": (np.full((2, 4), np.nan, np.float32),),
    "eye.npy": (np.zeros((3, 3), np.float32),),
    "complete.npy": (b"\x93NUMPY\x01\x00",),
    "camera.npy": (np.zeros((2, 18), np.float32),),
    "names.json": (b'[["a", "b"], 1]', b"[" * 100_000),
}


def test_a_shard_that_is_damaged_is_named(tmp_path):
    """Though its manifest has the sha256."""
    packed(tmp_path, balls=Balls(2, visibility=nothing_known()))
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    for name, contents in DAMAGED.items():
        path = tmp_path / f"shard-00000.{name}"
        whole = path.read_bytes()
        for content in (*contents, whole):
            path.write_bytes(content if isinstance(content, bytes) else npy(content))
            manifest["files"] = hash_files(tmp_path)
            (tmp_path / "manifest.json").write_text(json.dumps(manifest))
            if content is not whole:
                with pytest.raises(InputError, match=f"{name}: not a valid shard"):
                    assert Shards(tmp_path)[1]
    assert Shards(tmp_path)[1].name == "balls/1"
