"""Results as Markdown."""

import numpy as np

from experiments.summary import ExampleScores, summarise
from prism_jax.evaluation.metrics import Scores
from prism_jax.evaluation.tables import MEASURES, markdown

NAMED = {
    "data": "shapes",
    "split": "test",
    "protocol": "standard",
    "normalisation": "partial",
    "weights": "small",
    "seed": 7,
    "weights_commit": None,
    "steps": 3,
    "commit": "0123456789abcdef",
    "unit": "the data set's own unit",
}


def result(*clouds, emd: float | None = 0.25):
    scores = Scores(*[0.25] * len(Scores._fields))._replace(emd=emd)
    rows = [
        ExampleScores(f"{i}/easy/0", kind, None, {cloud: scores for cloud in clouds})
        for i, kind in enumerate(("bag", "car"))
    ]
    return NAMED | summarise(rows, ("bag", "car"), np.arange(len(rows)))


def test_every_cloud_has_a_row_in_both_tables():
    text = markdown(result("partial", "network", "completed"))
    assert text.splitlines()[0] == (
        "data shapes, split test, protocol standard, normalisation partial, weights "
        "small, seed 7, steps 3, commit 0123456789ab, 2 examples of 2 objects. Unit of "
        "length: the data set's own unit."
    )
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 * (2 + 3)
    assert "| network | 2500 [2500, 2500] | 250 [250, 250] " in text
    assert "| CD-L2 x1e4 | bag | car |" in text
    assert "| partial | 2500 | 2500 |" in text
    without = markdown(result("partial", "network", emd=None))
    heads = "F at 2 % | precision at 2 % | recall at 2 % | HD x1e2 | F@0.01 |"
    assert f"|  | CD-L2 x1e4 | CD-L1 x1e3 | {heads}" in without


def test_what_adaptation_changes_is_told_where_there_was_any():
    assert "adapt" not in markdown(result("partial", "network", "completed"))
    text = markdown(result("network_unadapted", "network"))
    head = "|  | adaptation changes | over 2 categories | carried by | without it |"
    assert head in text.splitlines()
    for _, _, label in MEASURES.values():
        assert f"| network, {label} | +0.0 % [+0.0, +0.0] | [+0.0, +0.0] |" in text
