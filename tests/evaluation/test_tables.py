"""Results as Markdown."""

import numpy as np

from prism_jax.evaluation import markdown, published_markdown
from prism_jax.evaluation.scoring import METRICS
from prism_jax.evaluation.summary import Scores, summarise

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


def result(*clouds, metrics=METRICS):
    scores = {metric: 0.25 for metric in metrics}
    rows = [
        Scores(f"{i}/easy/0", kind, None, {cloud: scores for cloud in clouds})
        for i, kind in enumerate(("bag", "car"))
    ]
    return NAMED | summarise(rows, ("bag", "car"), np.arange(len(rows)))


def test_the_first_line_names_what_was_scored():
    title = markdown(result("control", "output")).splitlines()[0]
    assert title == (
        "data shapes, split test, protocol standard, normalisation partial, weights "
        "small, seed 7, steps 3, commit 0123456789ab, 2 examples of 2 objects. Unit of "
        "length: the data set's own unit."
    )


def test_every_cloud_has_a_row_in_both_tables():
    text = markdown(result("control", "output", "unadapted"))
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 * (2 + 3)
    assert "| network's output, adapted | 2500 [2500, 2500] | 250 [250, 250] " in text
    assert "| CD-L2 x1e4 | bag | car |" in text
    assert "| partial itself | 2500 | 2500 |" in text


def test_nothing_is_called_adapted_that_was_not():
    assert "adapted" not in markdown(result("control", "output", "merged"))


def test_metrics_that_were_not_taken_have_no_column():
    text = markdown(result("control", "output", metrics=("cd_l2", "f_score")))
    assert "|  | CD-L2 x1e4 | F@0.01 |" in text


def test_published_columns_have_a_row_a_cloud():
    lines = published_markdown("pcn", result("control", "output")).splitlines()
    assert lines[0].startswith("data shapes, split test")
    assert lines[2] == "| CD-L1 x1e3 | bag | car | Average | F-Score@1% |"
    assert lines[4] == "| partial itself | 250 | 250 | 250 | 0.25 |"
