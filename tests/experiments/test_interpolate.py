"""Weights between where a training began and where it ended."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import interpolate
from prism_jax.completion.weights import load_pretrained, read_metadata, save_weights
from tests import launching


@pytest.fixture
def files(minimal, minimal_variables, reading, reading_fresh, tmp_path):
    """Of a network, and of one that went on from it and also reads what is known."""
    start, end = tmp_path / "start.safetensors", tmp_path / "end.safetensors"
    save_weights(start, minimal.config, minimal_variables, {"seed": 0})
    whole = jax.tree.map(lambda leaf: leaf + 1.0, reading_fresh)
    save_weights(end, reading, whole, {"seed": 3, "samples": 8, "calibration": [1]})
    return start, end


def between(files, share, tmp_path):
    start, end = files
    made = tmp_path / f"{share}.safetensors"
    given = f"--start={start}", f"--end={end}", f"--share={share}", f"--output={made}"
    assert launching.run(interpolate, *given) == 0
    return made


def test_it_lies_between_the_two(files, tmp_path):
    """What only the end has is the end's, but for its last layer, which begins as 0."""
    (_, start), (config, end) = (load_pretrained(str(path)) for path in files)
    made = between(files, 0.25, tmp_path)
    found_config, found = load_pretrained(str(made))
    assert found_config == config
    before, after = start["params"]["decoder"], end["params"]["decoder"]
    assert after.keys() - before.keys() == {"visibility_pooling"}
    decoder = found["params"]["decoder"]
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


@pytest.mark.slow
def test_nothing_of_the_way_is_the_start_and_all_of_it_the_end(files, tmp_path):
    (_, start), (_, end) = (load_pretrained(str(path)) for path in files)
    for share, expected in ((0.0, start), (1.0, end)):
        _, found = load_pretrained(str(between(files, share, tmp_path)))
        encoders = (tree["params"]["point_encoder"] for tree in (found, expected))
        assert jax.tree.all(jax.tree.map(np.array_equal, *encoders))


def test_weights_of_another_network_are_refused(files, tmp_path, capsys):
    start, end = files
    given = f"--start={end}", f"--end={start}", f"--output={tmp_path}/x.safetensors"
    assert launching.run(interpolate, *given) == 2
    assert "not weights of" in capsys.readouterr().err
