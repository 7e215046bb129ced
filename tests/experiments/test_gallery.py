"""The gallery's command, with a fake network."""

import numpy as np
from PIL import Image

from experiments import gallery
from experiments.assets import CELLS
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation.run import Predictions
from tests import launching


def test_writes_a_page_and_a_picture(tmp_path, monkeypatch):
    def fake(config, variables):
        poses = config.model.poses
        return lambda partials, eyes: Predictions(
            np.concatenate([partials + np.float32(0.1)] * poses, axis=1)
        )

    source = RecordedCells(CELLS)
    page = tmp_path / "out" / "cells.html"
    place = ["--dataset=recordings", f"--data_dir={source.root}", "--split=all"]
    sizes = ["--limit=3", "--size=32", "--columns=1", f"--output={page}"]
    monkeypatch.setattr(gallery, "prism_completer", fake)
    assert launching.run(gallery, *place, *sizes) == 0
    text = page.read_text().replace("\\u002f", "/")
    for index in range(3):
        assert (
            f"{index + 1}. {source[index].category} {source[index].name}: CD-L2" in text
        )
    with Image.open(page.with_suffix(".png")) as picture:
        assert picture.size == (4 * 32, 3 * (32 + 15))
