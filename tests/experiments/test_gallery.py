"""The gallery's command, with a fake network."""

import sys

import numpy as np
import pytest
from absl import flags
from PIL import Image

from experiments import gallery
from prism_jax.data.recordings import RecordedCells

OWN = ["dataset", "data_dir", "split", "normalisation", "limit", "output", "weights"]
OWN += ["columns", "size"]


def test_writes_a_page_and_a_picture(tmp_path, monkeypatch):
    def fake(config, variables):
        return lambda partials, eyes: {"output": partials + np.float32(0.1)}

    source = RecordedCells.bundled()
    page = tmp_path / "out" / "cells.html"
    place = ["--dataset=recordings", f"--data_dir={source.root}", "--split=all"]
    sizes = ["--limit=3", "--size=32", "--columns=1", f"--output={page}"]
    monkeypatch.setattr(sys, "argv", ["gallery", *place, *sizes])
    monkeypatch.setattr(gallery, "prism_completer", fake)
    try:
        with pytest.raises(SystemExit) as ended:
            gallery.run()
    finally:
        for name in OWN:
            delattr(flags.FLAGS, name)
    assert not ended.value.code
    text = page.read_text().replace("\\u002f", "/")
    for index in range(3):
        assert f"{index + 1}. robot cell {source[index].name}: CD-L2" in text
    with Image.open(page.with_suffix(".png")) as picture:
        assert picture.size == (4 * 32, 3 * (32 + 15))
