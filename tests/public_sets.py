"""Small public sets in their published layouts, written by tests that score on them."""

from pathlib import Path

import numpy as np

SYNSETS = {"02691156": "airplane", "02958343": "car"}


def write_shapenet55(root: Path, num_models: int = 2) -> None:
    """ShapeNet-55's test split: model i is of synset i % 2."""
    names = []
    for i in range(num_models):
        names.append(f"{list(SYNSETS)[i % 2]}-model{i}.npy")
        path = root / "shapenet_pc" / names[-1]
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, _cloud(i, 8192), allow_pickle=False)
    path = root / "ShapeNet-55" / "test.txt"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(names))


def _cloud(seed: int, count: int) -> np.ndarray:
    """A block off the origin, twice as long as wide."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return (points * [1.0, 0.5, 0.25] + 3.0).astype(np.float32)
