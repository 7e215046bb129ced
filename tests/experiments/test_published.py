"""Published columns, of results with known values and of sets in their layouts."""

import numpy as np

from experiments.published import OPTIONS, published_columns
from prism_jax.data.shapenet import ShapeNet
from prism_jax.evaluation.metrics import Scores
from prism_jax.evaluation.protocol import Protocol
from prism_jax.evaluation.run import Predictions, evaluate
from prism_jax.evaluation.summary import ExampleScores, summarise
from tests.public_sets import write_shapenet


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


def test_the_published_test_of_shapenet(tmp_path):
    """The partial given back, of a single model."""
    write_shapenet(tmp_path)
    source = ShapeNet("ShapeNet-55", tmp_path, "test", **OPTIONS)
    assert source.objects.tolist() == [0] * 24
    assert [len(source[i].partial) for i in (0, 8, 16)] == [6144, 4096, 2048]
    given = []

    def same(partials, eyes):
        given.extend(partials)
        return Predictions(partials)

    protocol = Protocol(256, 1.4, "own", "own", with_emd=False)
    result = evaluate(same, source, protocol, batch_size=8)
    columns = published_columns(result)
    # All pairs, of the first test of each difficulty.
    for start, head in ((0, "CD-S"), (8, "CD-M"), (16, "CD-H")):
        kept = result["per_example"]["clouds"]["network"]["cd_l2"][start : start + 8]
        assert np.isclose(columns[head], 1e3 * np.mean(kept), rtol=1e-6)
        complete, partial = source[start].complete, given[start]
        gaps = np.linalg.norm(complete[:, None] - partial, axis=2).astype(np.float64)
        expected = (gaps.min(0) ** 2).mean() + (gaps.min(1) ** 2).mean()
        assert np.isclose(kept[0], expected, rtol=1e-4)
    assert columns["CD-S"] < columns["CD-M"] < columns["CD-H"]
