"""What remembering gains: scores, their table, and a run from end to end."""

import numpy as np
import pytest

from experiments import accumulation
from prism_jax.weights import save_weights
from tests import launching


def test_scores_are_distances_of_both_kinds():
    """A plane, its half, and two remembered points, one of which has moved on."""
    grid = np.stack(np.meshgrid(*2 * [np.arange(10)]), axis=-1).reshape(-1, 2) / 100
    truth = np.column_stack([grid, np.zeros(100)])
    moved = truth[:1] + [0, 0, 0.04]
    points = np.concatenate([truth[truth[:, 0] < 0.05], moved])
    told = accumulation.score(points, np.concatenate([truth[:1], moved]), truth)
    missed = 1e3 * 10 * sum(0.01 * n for n in range(1, 6)) / 100
    wanted = [missed, 40 / 51, 0.5 * (missed + 40 / 51), 2, 1]
    assert told == pytest.approx(wanted)


def test_changes_have_intervals_over_sequences():
    scores = np.zeros((2, 2, 6, 6))
    scores[:, 1, :, 0] = [1, 1, 1, 3, 3, 3]
    text = accumulation.table(scores, np.repeat([0, 1], 3))
    assert "| known | truth to output, mm | 0.00 | 2.00 | +2.00 (+1.00 to +3.00) |" in (
        text
    )
    assert len(text.splitlines()) == 2 + 2 * len(accumulation.TOLD)


def test_what_something_hides_is_looked_past_and_not_forgotten():
    """Without all that is measured, what went away would never decay."""
    wall = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 40)]), axis=-1).reshape(-1, 2)
    wall = np.column_stack([np.full(len(wall), 3.0), wall])
    ball = np.array([2.0, 0, 0]) + 0.05 * np.random.default_rng(0).normal(size=(80, 3))
    memory = accumulation.Looking(0.1)
    for _ in range(4):
        memory.everything = np.concatenate([ball, wall])
        memory.add(ball, ball, np.zeros(3))
    other = ball + [0, 0.9, 0]
    memory.everything = np.concatenate([other, wall])
    assert len(memory.add(other, other, np.zeros(3))) == 0


@pytest.mark.slow
def test_it_runs_from_end_to_end(minimal, minimal_fresh, tmp_path, capsys):
    weights = tmp_path / "minimal.safetensors"
    save_weights(weights, minimal.config, minimal_fresh, {})
    sizes = "--num_sequences=2", "--num_frames=4", "--width=160"
    assert launching.run(accumulation, f"--weights={weights}", *sizes) == 0
    assert "| known | CD-L1, mm |" in capsys.readouterr().out
