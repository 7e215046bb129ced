from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.open_shapes.attachments import extent
from experiments.simulation.open_shapes.compositions import composition
from experiments.simulation.shapes import category_rng


def test_meshes_are_closed_solids_in_one_piece_on_the_floor():
    for seed in (*range(3), 2**40 + 7):
        mesh = make_open_shape(seed)
        assert mesh.is_watertight and mesh.is_winding_consistent
        assert mesh.volume > 0 and mesh.body_count == 1
        assert abs(mesh.bounds[0, 2]) < 1e-9
        assert 0.2 < mesh.extents.max() < 5.0


def test_many_are_the_same_on_their_left_and_right_and_some_are_not():
    alike = 0
    for seed in range(30):
        solid = composition(category_rng("open", seed))
        middle, _ = extent(solid)
        solid = solid.translate(-middle)
        apart = (solid - solid.mirror((1, 0, 0))).volume()
        alike += apart < 1e-3 * solid.volume()
    assert 8 < alike < 25
