"""What is exported runs without prism_jax, and gives what prism_jax gives."""

import pathlib
import subprocess
import sys

import jax
import numpy as np
import pytest

from experiments.export import export_adapt
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace

GOLDEN = pathlib.Path(__file__).parents[1] / "golden" / "export.npz"
PROGRAM = pathlib.Path(__file__).parents[2] / "experiments" / "run_exported.py"
BATCH = 2


@pytest.fixture(scope="module")
def exported(minimal, minimal_variables, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "adapt.jaxexport"
    config = minimal.config.with_adapt(num_steps=1)
    path.write_bytes(export_adapt(config, minimal_variables, BATCH))
    return path


def test_it_is_portable(exported):
    function = jax.export.deserialize(bytearray(exported.read_bytes()))
    assert function.platforms == ("cpu", "cuda")
    assert [aval.shape for aval in function.in_avals][1] == (BATCH, 3)
    results = function.out_tree.unflatten(function.out_avals)
    assert set(results) == {"points", "accepted", "objective", "left_out"}
    assert results["left_out"].shape == (BATCH,)
    assert results["objective"].shape == (BATCH, 2)


def test_the_newest_jax_loads_what_the_oldest_wrote():
    """Once it does not any more, raise the lower bound and write the file anew."""
    with np.load(GOLDEN, allow_pickle=False) as golden:
        function = jax.export.deserialize(bytearray(golden["function"]))
        done = jax.jit(function.call)(golden["scan"], np.zeros((1, 3), np.float32))
        np.testing.assert_allclose(done["points"], golden["points"], atol=1e-4)


@pytest.mark.slow
def test_a_clean_process_gets_the_same(exported, minimal, minimal_variables):
    from prism_jax import make_adapt

    folder, shape = exported.parent, (BATCH, minimal.model.backbone.num_points, 3)
    scans = np.random.default_rng(0).uniform([4, -1, -1], [5, 1, 1], shape)
    scans = scans.astype(np.float32)
    np.save(folder / "scans.npy", scans)
    files = [exported, folder / "scans.npy", folder / "completed.npy"]
    program = PROGRAM.read_text() + "\nassert 'prism_jax' not in sys.modules\n"
    # -I: neither the working directory nor the environment adds to the path.
    command = [sys.executable, "-I", "-c", program, *map(str, files)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    completed = np.load(files[-1])

    config = minimal.config.with_adapt(num_steps=1)

    def one(scan):
        workspace = Workspace.from_points(scan, minimal.model.margin)
        partial = workspace.to_unit(scan)
        camera = Camera.framing(partial, workspace.to_unit(np.zeros(3, np.float32)))
        done = make_adapt(config)(minimal_variables, partial, camera)
        return workspace.from_unit(done.points), done.accepted

    expected, accepted = jax.jit(jax.vmap(one))(scans)
    np.testing.assert_allclose(completed, expected, rtol=1e-5, atol=1e-5)
    assert ended.stdout.split()[1:] == [str(value) for value in accepted]
