"""A decoder that reads what the sensor knows."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.visibility import BACKGROUND, SURFACE, UNKNOWN, seen_by
from prism_jax.models.backbone import init_backbone
from prism_jax.models.config import BackboneConfig
from prism_jax.models.decoder import VisibilityPooling
from prism_jax.models.prism import predict, prepare_input
from prism_jax.training.inputs import inputs_of, visibility_of


@pytest.fixture(scope="module")
def maps(frame):
    """What the cloud itself says, and what a scan knows that has nothing around it."""
    partial, camera = frame
    return [seen_by(partial, camera.position, said) for said in ("unknown", "empty")]


def test_it_goes_on_from_weights_that_do_not(
    reading, reading_fresh, frame, maps, quick_jit
):
    """What is known changes nothing before training, and seeds and points after it."""

    @quick_jit
    def one(variables, known):
        inputs = prepare_input(
            *frame, jax.random.key(0), reading.model, visibility=known
        )
        found = predict(variables, inputs, reading.model)
        return found.stages[0], found.points

    def complete(variables):
        return zip(*[one(variables, known) for known in maps], strict=True)

    @jax.jit
    def init(key):
        decoder = init_backbone(key, reading.model.backbone)["params"]["decoder"]
        blocks = {name: block for name, block in decoder.items() if "block" in name}
        clues = {name: block["clues"] for name, block in blocks.items()}
        return {"pooling": decoder["visibility_pooling"], **clues}

    fresh = init(jax.random.key(0))

    def with_parts(pooling, **clues):
        decoder = {**reading_fresh["params"]["decoder"], "visibility_pooling": pooling}
        for name, own in clues.items():
            decoder[name] = {**decoder[name], "clues": own}
        params = {**reading_fresh["params"], "decoder": decoder}
        return {**reading_fresh, "params": params}

    for untrained, empty in complete(with_parts(**fresh)):
        np.testing.assert_allclose(untrained, empty, atol=1e-6)
    rng = np.random.default_rng(0)
    trained = jax.tree.map(lambda leaf: np.float32(rng.normal(size=leaf.shape)), fresh)
    for own, empty in complete(with_parts(**trained)):
        assert np.abs(empty - own).max() > 1e-2


def test_without_a_map_it_has_that_of_the_cloud(reading, frame, maps):
    """Of which the background is not known."""
    prepare = jax.jit(lambda *frame: prepare_input(*frame, reading.model).visibility)
    known = prepare(*frame, jax.random.key(0))
    chex.assert_trees_all_close(known, maps[0], rtol=1e-5, atol=1e-6)


def test_a_batch_of_maps_is_the_loop(reading, frame, maps):
    pooling = VisibilityPooling(reading.model.backbone)
    batch = jnp.stack([frame[0]] * 2), jax.tree.map(lambda *m: jnp.stack(m), *maps)

    @jax.jit
    def both(key):
        variables = pooling.init(key, *batch)
        variables = jax.tree.map(lambda leaf: leaf + 0.1, variables)
        alone = [pooling.apply(variables, frame[0], known) for known in maps]
        return pooling.apply(variables, *batch), jnp.stack(alone)

    together, alone = both(jax.random.key(0))
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-5)
    assert np.abs(alone[0] - alone[1]).max() > 1e-3


def test_every_other_row_of_a_training_knows_the_surface_alone(reading, tiny_frames):
    partials, cameras = tiny_frames
    batch = Batch(np.asarray(partials), None, np.asarray(cameras.position), None)
    known = visibility_of(batch, reading.model.backbone)
    for row, state in enumerate(np.asarray(known.state)):
        around = UNKNOWN if row % 2 else BACKGROUND
        assert set(np.unique(state)) == {SURFACE, around}
    assert not known.depth[known.state == UNKNOWN].any()
    # Maps that come with the batch are not made anew.
    given = batch._replace(visibility=known._replace(depth=known.depth + 1))
    inputs = jax.jit(lambda batch, key: inputs_of(batch, key, reading.model))
    again = inputs(given, jax.random.key(0)).visibility
    np.testing.assert_array_equal(again.state, known.state)
    seen = np.asarray(known.state) == SURFACE
    np.testing.assert_allclose(again.depth[seen], known.depth[seen] + 1)


def test_seeds_cannot_read_alone():
    with pytest.raises(ValueError, match="needs reads_visibility"):
        BackboneConfig(seeds_read_visibility=True)
