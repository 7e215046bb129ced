"""Small public sets in their published layouts, written by tests that score on them."""

import json
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


def write_pcn(root: Path) -> None:
    """PCN's test split of one airplane and one car."""
    entries = []
    for i, (synset, category) in enumerate(SYNSETS.items()):
        entries.append({"taxonomy_id": synset, "taxonomy_name": category})
        entries[-1]["test"] = [f"model{i}"]
        complete, folder = _cloud(i, 16384), root / "test"
        _write_pcd(folder / "complete" / synset / f"model{i}.pcd", complete)
        _write_pcd(folder / "partial" / synset / f"model{i}" / "00.pcd", complete[:700])
    (root / "PCN.json").write_text(json.dumps(entries))


def _cloud(seed: int, count: int) -> np.ndarray:
    """A block off the origin, twice as long as wide."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return (points * [1.0, 0.5, 0.25] + 3.0).astype(np.float32)


def _write_pcd(path: Path, points: np.ndarray) -> None:
    size = f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n" + size
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())
