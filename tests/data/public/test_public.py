"""Public sets by name."""

from prism_jax.data.datasets import open_dataset


def test_options_reach_the_loader(tmp_path, cloud, write):
    write(tmp_path / "ShapeNet-34" / "test.txt", "02691156-a.npy\n")
    write(tmp_path / "shapenet_pc" / "02691156-a.npy", cloud(0, 8192))
    assert len(open_dataset("shapenet34", "test", tmp_path)) == 1
    assert len(open_dataset("shapenet34", "test", tmp_path, difficulty="easy")) == 8
