"""Results side by side."""

import json

import numpy as np
import pytest

from experiments.comparison import ABOVE, Row, comparison, comparison_markdown
from experiments.summary import ExampleScores, summarise
from prism_jax.evaluation.metrics import Scores


def result(first, second, objects="ab", kinds=("bag", "bag")):
    """Of two objects, scored these in every metric; the partial twice as much."""
    rows = []
    for name, kind, value in zip(objects, kinds, (first, second), strict=True):
        scores = Scores(*[value] * len(Scores._fields))
        twice = Scores(*[2 * value] * len(Scores._fields))
        clouds = {"partial": twice, "network": scores}
        rows.append(ExampleScores(name, kind, None, clouds))
    return {"unit": "metres", **summarise(rows, ("bag", "car"), np.arange(len(rows)))}


def test_rows_have_their_own_cloud_and_the_change_against_one():
    before, after = result(0.1, 0.3), result(0.1, 0.2)
    given = {
        "partial": Row(before, "partial"),
        "net": Row(before, parameters=1_500_000, samples=9000),
        "better": Row(after, parameters=2_000_000),
    }
    table = comparison(given, "net", data="boxes", split="test", commit="0" * 40)
    rows = table["rows"]
    assert rows["partial"]["mean"]["cd_l2"] == pytest.approx(0.4)
    better = rows["better"]["change"]["cd_l2"]
    assert better["change"] == pytest.approx(-0.25)
    # Resampled, both objects are the first, or both the second.
    assert better["interval"] == pytest.approx([-1 / 3, 0])
    lines = comparison_markdown(json.loads(json.dumps(table))).splitlines()
    assert lines[0] == (
        "data boxes, split test, commit 000000000000, 2 examples of 2 objects. Unit of "
        "length: metres."
    )
    assert lines[2].endswith("| recall at 2 % | parameters | samples |")
    assert lines[4].startswith("| partial | 4000 [2000, 6000] | ")
    assert lines[4].endswith("] |  |  |") and lines[2].count("|") == 9
    assert lines[5].endswith("| 1.50 M | 9,000 |")
    assert lines[6].endswith("| 2.00 M |  |")
    assert lines[8] == "| against net | log CD-L1 | F at 2 % | CD-L2 |"
    twice, change = "+100.0 % [+100.0, +100.0]", "-25.0 % [-33.3, +0.0]"
    assert lines[10] == f"| partial | {twice} | {twice} | {twice} |"
    log = f"{100 * (2 / 3) ** 0.5 - 100:+.1f} % [-33.3, +0.0]"
    assert lines[11] == f"| better | {log} | {change} | {change} |"
    above = comparison(given, ABOVE)["rows"]
    assert above["net"]["change"]["cd_l2"]["change"] == pytest.approx(-0.5)


def test_a_change_says_which_category_carries_it():
    kinds = ("bag", "car")
    before, after = result(0.1, 0.3, kinds=kinds), result(0.1, 0.2, kinds=kinds)
    table = comparison({"net": Row(before), "better": Row(after)}, "net")
    lines = comparison_markdown(table).splitlines()
    heads = "F at 2 % | CD-L2 | over 2 categories | carried by | without it |"
    assert lines[-3].endswith(f"| {heads}") and "parameters" not in lines[2]
    carried = "[-33.3, +0.0] | car (1 of 2): -25.0 % | +0.0 % [+0.0, +0.0] |"
    assert lines[-1].endswith(f"| -25.0 % [-33.3, +0.0] | {carried}")


def test_other_examples_are_refused_and_what_is_zero_has_no_change():
    rows = {"net": Row(result(0.1, 0.3)), "other": Row(result(0.1, 0.3, "ac"))}
    with pytest.raises(ValueError, match="not of the same examples"):
        comparison(rows, "net")
    # As no point of an untrained network is within the F-score's reach.
    rows = {"net": Row(result(0.0, 0.0)), "other": Row(result(1.0, 2.0))}
    table = comparison(rows, "net")
    assert table["rows"]["other"]["change"] == {}
    assert comparison_markdown(table).splitlines()[-1] == "| other |  |  |  |"
