"""Sums of trees: what scikit-learn's say, row by row or together."""

import json
from typing import ClassVar

import numpy as np
import pytest
from sklearn.ensemble import GradientBoostingRegressor

from experiments.calibrate import FOLDS, boosted, rank_correlation, trees_of
from prism_jax.uncertainty.trees import Trees

RNG = np.random.default_rng(0)
ROWS = RNG.normal(size=(400, 5)).astype(np.float32).astype(float)
WANTED = ROWS[:, 1] * (ROWS[:, 3] > 0) + np.abs(ROWS[:, 0])


class Five(Trees):
    """Of five numbers."""

    NAMES: ClassVar[tuple[str, ...]] = tuple("abcde")


def made_of(model):
    return Five(**trees_of(model), bounds=np.array([-9.0, 9.0]))


@pytest.mark.parametrize("depth", [1, 4])
def test_they_say_what_scikit_learns_say(depth):
    model = GradientBoostingRegressor(max_depth=depth, n_estimators=15, random_state=0)
    trees = made_of(model.fit(ROWS, WANTED))
    np.testing.assert_allclose(trees.sums(ROWS), model.predict(ROWS), atol=1e-12)
    again = Five.from_dict(json.loads(json.dumps(trees.to_dict())))
    np.testing.assert_allclose(again.sums(ROWS), model.predict(ROWS), atol=1e-3)


def test_a_row_has_the_same_bits_alone_and_among_others():
    model = GradientBoostingRegressor(max_depth=3, n_estimators=150, random_state=0)
    trees = made_of(model.fit(ROWS, WANTED))
    alone = np.array([trees.sums(row) for row in ROWS])
    assert trees.sums(ROWS.reshape(8, 50, 5)).tobytes() == alone.tobytes()


def test_no_sample_is_predicted_by_trees_that_saw_it():
    """A number that names each object predicts nothing of an object left out."""
    group = 2 * RNG.integers(0, 20, 400)
    error = RNG.normal(size=20)[group // 2]
    rows = np.stack([group.astype(float), RNG.normal(size=400)], axis=1)
    settings = {"n_estimators": 40, "max_depth": 4, "learning_rate": 0.2}
    fold = group // 2 % FOLDS
    _, said, weights = boosted(rows, error, ["a"] * 100 + ["b"] * 300, fold, settings)
    np.testing.assert_allclose(weights[[0, 399]], [4, 4 / 3])
    assert rank_correlation(said, error) < 0.5


def test_rank_correlation_of_what_does_not_vary():
    assert rank_correlation(np.ones(5), np.arange(5.0)) is None
    assert rank_correlation(np.ones(0), np.ones(0)) is None
    rising = np.arange(5.0)
    assert rank_correlation(rising, np.exp(rising)) == pytest.approx(1.0)
