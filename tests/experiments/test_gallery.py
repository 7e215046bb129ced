"""Examples to look at: which ones, that they show what is scored, and the command."""

import re

import numpy as np
import pytest
from PIL import Image

from experiments import gallery
from experiments.assets import CELLS
from experiments.gallery_page import COLUMNS, complete_items, gallery_page
from experiments.protocol import Protocol
from experiments.scored_run import Predictions, evaluate
from prism_jax.data.recordings import RecordedCells
from tests import launching

PROTOCOL = Protocol(64, 1.4, with_emd=False)


def moved(partials, eyes):
    return Predictions(partials + np.float32([0.3, 0.0, 0.2]))


@pytest.fixture(scope="module")
def shown():
    return complete_items(moved, RecordedCells(CELLS), [0, 3], PROTOCOL)


def test_numbers_are_those_of_the_evaluation(shown):
    scores = evaluate(moved, RecordedCells(CELLS), PROTOCOL, 4)["per_example"]
    for item, index in zip(shown, (0, 3), strict=True):
        for name, value in (("partial", item.before), ("completed", item.after)):
            expected = scores["clouds"][name]["cd_l2"][index]
            assert value == pytest.approx(expected, 1e-5)
        kind, name = scores["category"][index], scores["name"][index]
        assert item.name == f"{kind} {name}"
        assert f"completed {1e4 * item.after:.4g}" in item.label
        cloud = np.concatenate([item.measured, item.added])
        assert len(item.errors) == len(cloud)
        for row in (0, len(item.measured), -1):
            apart = np.linalg.norm(item.complete - cloud[row], axis=1).min()
            assert item.errors[row] == pytest.approx(apart)


def test_page_has_every_example_and_needs_no_network(shown):
    page = gallery_page(shown, "small <on> cells").replace("\\u002f", "/")
    for number, item in enumerate(shown, start=1):
        assert f"{number}. {item.label}" in page
    assert "small &lt;on&gt; cells" in page
    assert not re.search(r"<(script|link)[^>]*(src|href)=", page)
    assert page.count('"visible":false') >= len(COLUMNS)


def test_the_command_writes_a_page_and_a_picture(tmp_path, monkeypatch):
    def fake(config, variables):
        poses = config.model.poses
        return lambda partials, eyes: Predictions(
            np.concatenate([partials + np.float32(0.1)] * poses, axis=1)
        )

    page, source = tmp_path / "out" / "cells.html", RecordedCells(CELLS)
    place = ["--dataset=recordings", f"--data_dir={CELLS}", "--split=all"]
    sizes = ["--limit=2", "--size=32", "--columns=1", f"--output={page}"]
    monkeypatch.setattr(gallery, "prism_completer", fake)
    assert launching.run(gallery, *place, *sizes) == 0
    text = page.read_text().replace("\\u002f", "/")
    for number, example in enumerate((source[0], source[1]), start=1):
        assert f"{number}. {example.category} {example.name}: CD-L2" in text
    with Image.open(page.with_suffix(".png")) as picture:
        assert picture.size == (4 * 32, 2 * (32 + 15))
