"""Cosines of gradients and steps against them, beside plain steps and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from experiments import loss_gradients
from experiments.assets import CELLS
from experiments.loss_gradients import (
    LOSSES,
    ORACLE,
    agreement_markdown,
    cosines_and_changes,
    gradient_agreement,
)
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.data.recordings import RecordedCells
from prism_jax.evaluation.protocol import Protocol
from prism_jax.geometry.camera import Camera
from prism_jax.losses.chamfer import chamfer
from prism_jax.models.prism import hold_decoding, prepare_input

EYE = jnp.array([2.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config


@pytest.fixture(scope="module")
def variables(minimal_fresh):
    return minimal_fresh


@pytest.fixture(scope="module")
def clouds():
    keys = jax.random.split(jax.random.key(1))
    return [jax.random.uniform(key, (64, 3), minval=-0.7, maxval=0.7) for key in keys]


@pytest.mark.slow
def test_cosine_is_what_a_step_along_the_gradient_shows(config, variables, clouds):
    partial, complete = clouds
    found = jax.jit(cosines_and_changes(config))(
        variables, partial, EYE, complete, jax.random.key(0)
    )

    @jax.jit
    def prepare(partial, eye):
        camera = Camera.framing(partial, eye)
        frame = prepare_input(partial, camera, jax.random.key(0), config.model)
        return hold_decoding(variables, frame, config.model)

    frame = prepare(partial, EYE)
    start, unravel = ravel_pytree(variables["params"]["point_encoder"])

    def values(flat):
        params = {**variables["params"], "point_encoder": unravel(flat)}
        losses, prediction = objective({**variables, "params": params}, frame, config)
        return jnp.stack([losses.denoise, chamfer(prediction.points, complete)])

    by_loss, by_error = jax.jit(jax.jacrev(values))(start)
    values = jax.jit(values)
    step = 1e-3 * by_loss / jnp.linalg.norm(by_loss)
    rise = (values(start + step)[1] - values(start - step)[1]) / 2e-3
    cosine = float(rise / jnp.linalg.norm(by_error))
    cosines, changes = np.asarray(found)
    place = LOSSES.index("denoising, Eq. 6")
    assert cosines[place] == pytest.approx(cosine, abs=0.02)
    assert np.abs(cosines).max() <= 1.0001
    for row, gradient in ((place, by_loss), (-1, by_error)):
        unit = gradient / jnp.linalg.norm(gradient)
        after = values(start - config.adapt.step_size * unit)[1] / values(start)[1] - 1
        assert changes[row] == pytest.approx(float(after), rel=1e-3, abs=1e-6)
    assert changes[-1] < 0


@pytest.mark.slow
def test_a_loss_that_is_the_error_has_cosine_one(
    config, variables, clouds, monkeypatch
):
    partial, complete = clouds

    def itself(variables, frame, config):
        losses, prediction = objective(variables, frame, config)
        error = chamfer(prediction.points, complete)
        return losses._replace(normal=3 * error, align=-error, denoise=0 * error), (
            prediction
        )

    monkeypatch.setattr(loss_gradients, "test_time_objective", itself)
    found = jax.jit(cosines_and_changes(config))(
        variables, partial, EYE, complete, jax.random.key(0)
    )
    names = (*LOSSES, ORACLE)
    cosine, change = (dict(zip(names, row, strict=True)) for row in np.asarray(found))
    assert cosine[ORACLE] == pytest.approx(1, abs=1e-5)
    assert cosine["normals, Eq. 5"] == pytest.approx(1, abs=1e-5)
    assert cosine["alignment, Eq. 9"] == pytest.approx(-1, abs=1e-5)
    assert cosine["denoising, Eq. 6"] == 0
    assert change[ORACLE] < 0 < change["alignment, Eq. 9"]
    assert change["normals, Eq. 5"] == pytest.approx(change[ORACLE], rel=1e-3)
    assert change["denoising, Eq. 6"] == pytest.approx(0, abs=1e-6)


@pytest.mark.slow
def test_table_of_a_source(config, variables):
    source = RecordedCells(CELLS)
    protocol = Protocol(config.model.backbone.num_points, config.model.margin)
    result = gradient_agreement(
        config, variables, source, protocol, limit=3, batch_size=2
    )
    assert (result["num_examples"], result["num_objects"]) == (3, 3)
    again = gradient_agreement(
        config, variables, source, protocol, limit=3, batch_size=2
    )
    assert result == again
    for row in result["losses"].values():
        low, high = row["interval"]
        assert low <= row["mean"] <= high
        assert 0 <= row["positive"] <= 1
        low, high = row["change_interval"]
        assert low <= row["change"] <= high
    assert list(result["losses"]) == [*LOSSES, ORACLE]
    text = agreement_markdown(result)
    assert all(f"| {name} | " in text for name in LOSSES)
    assert "3 examples of 3 objects" in text
