"""ShapeNet in PoinTr's layout, written by tests that read it or score on it."""

from pathlib import Path

import numpy as np

KEYS = ("02691156-1a04e3", "02958343-u6028-fe5f4")


def write_shapenet(root: Path, keys=KEYS[:1], subset="ShapeNet-55", split="test"):
    """Blocks off the origin, twice as long as wide, and a list of them."""
    for folder in ("shapenet_pc", subset):
        (root / folder).mkdir(parents=True, exist_ok=True)
    (root / subset / f"{split}.txt").write_text("".join(f"{key}.npy\n" for key in keys))
    for seed, key in enumerate(keys):
        points = np.random.default_rng(seed).uniform(-1, 1, (8192, 3))
        points = (points * [1.0, 0.5, 0.25] + 3.0).astype(np.float32)
        np.save(root / "shapenet_pc" / f"{key}.npy", points)
