"""Weights between where a training began and where it ended."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments import interpolate, training
from prism_jax.completion.weights import load_pretrained, read_metadata, save_weights
from tests import launching


def as_numpy(path):
    config, variables = load_pretrained(path)
    return config, jax.tree.map(np.asarray, variables)


def test_it_lies_between_the_two(
    minimal, minimal_variables, reading, reading_fresh, tmp_path, monkeypatch, capsys
):
    """What only the end has is the end's, but for its last layer, which begins as 0."""
    paths = [tmp_path / f"{name}.safetensors" for name in ("start", "end", "made")]
    start, end, made = paths
    save_weights(start, minimal.config, minimal_variables, {"seed": 0})
    whole = jax.tree.map(lambda leaf: np.asarray(leaf) + 1, reading_fresh)
    save_weights(end, reading, whole, {"seed": 3, "samples": 8, "calibration": [1]})
    decoder = reading_fresh["params"]["decoder"]
    pooling = decoder["visibility_pooling"]
    pooling = {**pooling, "out": jax.tree.map(jnp.zeros_like, pooling["out"])}
    params = {"decoder": {**decoder, "visibility_pooling": pooling}}
    params = {**reading_fresh["params"], **params}
    silent = {**reading_fresh, "params": params}
    # Arithmetic of NumPy's arrays is not compiled.
    for module in (interpolate, training):
        monkeypatch.setattr(module, "load_pretrained", as_numpy)
    monkeypatch.setattr(training, "init_backbone", lambda key, model: silent)
    given = f"--start={start}", f"--end={end}", f"--output={made}"
    assert launching.run(interpolate, *given, "--share=0.25") == 0
    found_config, found = load_pretrained(str(made))
    assert found_config == reading
    trees = (minimal_variables, whole, found)
    before, after, decoder = (tree["params"]["decoder"] for tree in trees)
    assert after.keys() - before.keys() == {"visibility_pooling"}
    pooling, own = after["visibility_pooling"], decoder["visibility_pooling"]
    jax.tree.map(np.testing.assert_array_equal, own["point"], pooling["point"])
    nothing = jax.tree.map(jnp.zeros_like, pooling["out"])
    for tree, first, last in (
        (own["out"], nothing, pooling["out"]),
        *((decoder[name], before[name], after[name]) for name in before),
    ):
        # Blocks hold what only the end reads, too.
        for name in first.keys() & tree.keys():
            jax.tree.map(
                lambda x, a, b: np.testing.assert_allclose(
                    x, 0.75 * a + 0.25 * b, 1e-5
                ),
                *(part[name] for part in (tree, first, last)),
            )
    known = read_metadata(str(made))
    assert known["samples"] == 8 and known["interpolated"]["share"] == 0.25
    # It was fitted to the end alone.
    assert "calibration" not in known
    given = f"--start={end}", f"--end={start}", f"--output={made}"
    assert launching.run(interpolate, *given) == 2
    assert "not weights of" in capsys.readouterr().err
