import pytest

from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.shapes import CATEGORIES, make_shape

OFF_THE_FLOOR = {"chair", "table", "cabinet", "lamp", "mug", "airplane", "arm"}
"""What does not stand at z = 0 to the last bit."""


@pytest.mark.parametrize("category", [*CATEGORIES, "open"])
def test_a_mesh_is_a_closed_solid_in_one_piece_of_its_size(category):
    seed = 2**40 + 7
    is_open = category == "open"
    mesh = make_open_shape(seed) if is_open else make_shape(category, seed)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0 and mesh.body_count == 1
    assert mesh.extents.min() > 0.05 and 0.4 < mesh.extents.max() < 4.0
    assert abs(mesh.bounds[0, 2]) < (0.2 if category in OFF_THE_FLOOR else 1e-9)
    # Winding by the parity of rays: a union leaves no inner walls.
    points, faces = mesh.sample(100, return_index=True, seed=0)
    step = 1e-5 * mesh.face_normals[faces]
    assert sum(~mesh.contains(points + step)) > 97
    assert sum(mesh.contains(points - step)) > 97
