"""Which terms rose is counted over the frames whose adaptation was accepted."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from experiments import verdicts
from experiments.assets import CELLS
from prism_jax.adaptation.objective import Losses
from tests import launching


def fake(config):
    """The objective falls and Eq. 4 rises; refused where the sensor is to the left."""

    def adapt(variables, partial, camera):
        accepted = camera.position[0] > 0
        falls, rises = jnp.array([2.0, 1.0]), jnp.array([1.0, 1.5])
        refused = jnp.where(accepted, falls, rises)
        losses = Losses(refused, rises, falls, refused, falls)
        return SimpleNamespace(accepted=accepted, losses=losses)

    return adapt


@pytest.mark.parametrize("batch_size", [3, 8])
def test_counts_the_accepted(tmp_path, monkeypatch, batch_size):
    monkeypatch.setattr(verdicts, "make_adapt", fake)
    output = tmp_path / "verdicts.json"
    place = ["--dataset=recordings", f"--data_dir={CELLS}", "--split=all", "--limit=5"]
    sizes = [f"--batch_size={batch_size}", f"--output={output}"]
    assert launching.run(verdicts, *place, *sizes) == 0
    result = json.loads(output.read_text())
    assert result["num_examples"] == 5 and 0 < result["accepted"] < 1
    assert result["rose"] == {
        "objective": 0.0,
        "depth_consistency": 1.0,
        "normal": 0.0,
        "denoise": 0.0,
        "align": 0.0,
    }
    text = output.with_suffix(".md").read_text()
    assert f"accepted for {100 * result['accepted']:.0f} %" in text
    assert "| depth consistency, Eq. 4 | 100 % |" in text
