"""What fits and judges the learned term, on laws that are known."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import learned_term
from experiments.learned_term import HELD_OUT, LOSSES, ORACLE, Views, fitted
from experiments.simulation.shapes.build import ShapesConfig, build_shapes
from prism_jax.losses.learned import NAMES
from prism_jax.models.error_head import log_errors
from prism_jax.weights import load_pretrained, read_metadata, save_weights
from tests import launching
from tests.trees import bitwise


def test_a_law_is_found_again_and_the_same_every_time():
    rng = np.random.default_rng(0)
    clues = rng.normal(size=(30, 64, len(NAMES))).astype(np.float32)
    wanted = -3 + np.sin(clues[..., 0]) + 0.5 * clues[..., 9]
    first = fitted(Views(clues, wanted), 200, 1e-2, 0)
    assert bitwise(first, fitted(Views(clues, wanted), 200, 1e-2, 0))
    off = np.asarray(log_errors(first, jnp.asarray(clues))) - wanted
    assert (off**2).mean() < 0.05 * wanted.var()


def test_what_is_foretold_in_closed_form():
    rng = np.random.default_rng(1)
    wanted = rng.normal(size=(40, 50))
    groups = {"interval": np.arange(40), "kind_interval": np.arange(40) % 4}
    perfect = learned_term._foretold(wanted, wanted, groups)
    assert perfect["r2"]["mean"] == 1 and perfect["rank_pooled"] == pytest.approx(1)
    noisy = wanted + rng.normal(size=wanted.shape)
    found = learned_term._foretold(noisy, wanted, groups)
    expected = 1 - ((noisy - wanted) ** 2).sum() / ((wanted - wanted.mean()) ** 2).sum()
    assert found["r2"]["mean"] == pytest.approx(expected)
    low, high = found["r2"]["interval"]
    assert low < expected < high
    nothing = learned_term._foretold(np.zeros_like(wanted), wanted, groups)
    assert nothing["rank_within"]["mean"] == 0 and nothing["rank_pooled"] is None


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with shapes to fit on and to measure with."""
    folder = tmp_path_factory.mktemp("data")
    build_shapes(ShapesConfig("train", num_shapes=10, num_views=1), folder, 0, False)
    build_shapes(ShapesConfig("validation", num_shapes=2), folder, 0, False)
    return folder


@pytest.mark.slow
def test_the_command_writes_the_weights_with_it(
    place, reading, reading_fresh, tmp_path, monkeypatch, capsys
):
    """And what it is worth beside them; the cosine of the error with itself is one."""
    weights = tmp_path / "start.safetensors"
    save_weights(weights, reading, reading_fresh, {"seed": 3})
    monkeypatch.setattr(
        learned_term, "SETS", {"shapes": ("shapes", "validation", True)}
    )
    output = tmp_path / "fitted.safetensors"
    given = [
        f"--weights={weights}",
        f"--data_dir={place}",
        "--mixture=shapes:1",
        "--views=4",
        "--points=32",
        "--epochs=2",
        "--limit=2",
        f"--output={output}",
    ]
    assert launching.run(learned_term, *given) == 0
    found, with_it = load_pretrained(str(output))
    assert found == reading
    own = dict(with_it["params"])
    assert set(own.pop("learned")) == {"dense_0", "dense_1", "dense_2"}
    assert bitwise({**with_it, "params": own}, reading_fresh)
    metadata = read_metadata(str(output))
    assert metadata["seed"] == 3 and metadata["learned_term"]["views"] == 4
    result = json.loads(output.with_suffix(".json").read_text())
    assert list(result["sets"]) == [HELD_OUT, "shapes"]
    for each in result["sets"].values():
        assert list(each["losses"]) == [*LOSSES, ORACLE]
        oracle = each["losses"][ORACLE]
        assert oracle["cosine"]["mean"] == pytest.approx(1, abs=1e-4)
    text = output.with_suffix(".md").read_text()
    assert text in capsys.readouterr().out and "| shapes | the learned term | " in text


def test_weights_that_do_not_read_visibility_are_refused(
    place, tmp_path, minimal, minimal_variables, capsys
):
    weights = tmp_path / "blind.safetensors"
    save_weights(weights, minimal.config, minimal_variables, {})
    given = [f"--weights={weights}", f"--data_dir={place}", "--mixture=shapes:1"]
    status = launching.run(learned_term, *given, f"--output={tmp_path}/x.safetensors")
    assert status == 2 and "reads no visibility; use weights that do" in (
        capsys.readouterr().err
    )
