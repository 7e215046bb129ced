"""Published columns, of results with known values and of sets in their layouts."""

import numpy as np

from experiments.published import published_columns
from experiments.summary import ExampleScores, summarise
from prism_jax.evaluation.metrics import Scores


def row(name, category, value) -> ExampleScores:
    scores = Scores(*[value] * len(Scores._fields))
    return ExampleScores(name, category, None, {"partial": scores, "network": scores})


def test_shapenet_averages_categories_and_not_examples():
    """Three cars at ten times the only bag's distances."""
    factors = {"bag-0": 1.0, "car-1": 10.0, "car-2": 10.0, "car-3": 10.0}
    rows = [
        row(f"{name}/{difficulty}/{view}", name[:3], 1e-3 * factor * value)
        for name, factor in factors.items()
        for difficulty, value in [("easy", 1.0), ("median", 2.0), ("hard", 6.0)]
        for view in range(8)
    ]
    result = summarise(rows, ("bag", "car"), np.arange(96) // 24)
    columns = published_columns(result)
    assert list(columns) == ["CD-S", "CD-M", "CD-H", "CD-Avg", "F-Score@1%"]
    expected = [5.5, 11.0, 33.0, 16.5, 1e-3 * 16.5]
    np.testing.assert_allclose(list(columns.values()), expected, rtol=1e-6)
    assert published_columns(result, "partial") == columns
