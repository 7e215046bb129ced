"""A decoder that reads what the sensor knows."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.training import overlaid
from prism_jax.data.pipeline import Batch
from prism_jax.geometry.visibility import (
    BACKGROUND,
    SURFACE,
    UNKNOWN,
    seen_by,
)
from prism_jax.models.backbone import (
    decode,
    encode_points,
    init_backbone,
    partial_indices,
)
from prism_jax.models.config import BackboneConfig
from prism_jax.models.prism import predict, prepare_input
from prism_jax.training.inputs import inputs_of, visibility_of


@pytest.fixture(scope="module")
def model(reading):
    return reading.model


@pytest.fixture(scope="module")
def untrained(model, minimal_fresh):
    """Variables of `minimal`, with the parts for it as they begin."""
    fresh = init_backbone(jax.random.key(0), model.backbone)
    return overlaid(fresh, minimal_fresh)


@pytest.fixture(scope="module")
def trained(untrained):
    """The same with numbers in them."""
    rng = np.random.default_rng(0)
    params = untrained["params"]
    block = params["decoder"]["block_0"]
    reading = {"clues": block["clues"]}
    pooling = params["decoder"]["visibility_pooling"]
    reading, pooling = jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype),
        (reading, pooling),
    )
    read = {"block_0": {**block, **reading}, "visibility_pooling": pooling}
    decoder = {**params["decoder"], **read}
    return {**untrained, "params": {**params, "decoder": decoder}}


@pytest.fixture(scope="module")
def complete(model, quick_jit):
    def one(variables, partial, camera, known):
        key = jax.random.key(0)
        inputs = prepare_input(partial, camera, key, model, visibility=known)
        return predict(variables, inputs, model).points, inputs.visibility

    return quick_jit(one)


@pytest.fixture(scope="module")
def frame(tiny_frames):
    return jax.tree.map(lambda leaf: leaf[0], tiny_frames)


def test_it_goes_on_from_weights_that_do_not(
    minimal, minimal_fresh, untrained, complete, frame, quick_jit
):
    """Untrained, it says what they say, whatever is known."""
    own = minimal.model

    @quick_jit
    def blind(partial, camera):
        inputs = prepare_input(partial, camera, jax.random.key(0), own)
        assert inputs.visibility is None
        return predict(minimal_fresh, inputs, own).points

    partial, camera = frame
    known = seen_by(partial, camera.position, "empty")
    told, _ = complete(untrained, partial, camera, known)
    np.testing.assert_allclose(told, blind(partial, camera), atol=1e-5)


def test_what_is_known_changes_what_is_said(trained, complete, frame):
    """And without a map it has that of the cloud, of which the background is not."""
    partial, camera = frame
    own = seen_by(partial, camera.position)
    empty = seen_by(partial, camera.position, "empty")
    blind, known = complete(trained, partial, camera, None)
    chex.assert_trees_all_close(known, own, rtol=1e-5, atol=1e-6)
    told, other = (complete(trained, partial, camera, map)[0] for map in (own, empty))
    changed = np.abs(other - blind).max()
    assert changed > 1e-2
    # Two programs, which round otherwise.
    assert np.abs(told - blind).max() < 1e-3 * changed


def test_the_seeds_know_of_it(model, trained, frame, quick_jit):
    """In one view as in a batch of them."""
    partial, camera = frame
    maps = [seen_by(partial, camera.position, told) for told in ("unknown", "empty")]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *maps)

    @quick_jit
    def seeds(partial, known):
        indices = partial_indices(partial, model.backbone)
        encoded = encode_points(trained, model.backbone, partial, indices)
        decoded = decode(trained, model.backbone, partial, encoded, None, known)
        return decoded.stages[0]

    found = [seeds(partial, known) for known in maps]
    assert np.abs(found[0] - found[1]).max() > 1e-2
    together = jax.vmap(lambda known: seeds(partial, known))(both)
    np.testing.assert_allclose(together, np.stack(found), rtol=1e-5, atol=1e-5)


def test_the_seeds_do_not_read_what_the_blocks_do_not():
    with pytest.raises(ValueError, match="needs reads_visibility"):
        BackboneConfig(seeds_read_visibility=True)


def test_every_other_row_of_a_training_knows_the_surface_alone(model, tiny_frames):
    partials, cameras = tiny_frames
    eyes = cameras.position
    batch = Batch(np.asarray(partials), None, np.asarray(eyes), None)
    read = jax.jit(lambda batch: visibility_of(batch, model.backbone))
    known = read(batch)
    states = [set(np.unique(state)) for state in np.asarray(known.state)]
    for row, found in enumerate(states):
        around = UNKNOWN if row % 2 else BACKGROUND
        assert found == {SURFACE, around}
    # Maps that come with the batch are not made anew.
    given = known._replace(depth=known.depth + 1)
    again = read(batch._replace(visibility=given))
    seen = np.asarray(known.state) == SURFACE
    np.testing.assert_allclose(again.depth[seen], known.depth[seen] + 1)
    inputs = jax.jit(lambda batch, key: inputs_of(batch, key, model))(
        batch, jax.random.key(0)
    )
    np.testing.assert_array_equal(inputs.visibility.state, known.state)


def test_a_decoder_that_reads_needs_a_map(model, trained, frame):
    def decoded(partial, known):
        indices = partial_indices(partial, model.backbone)
        encoded = encode_points(trained, model.backbone, partial, indices)
        return decode(trained, model.backbone, partial, encoded, None, known)

    with pytest.raises(ValueError, match="needs a map"):
        jax.eval_shape(decoded, frame[0], None)
