"""Eq. 12 of the smallest network, in double precision, against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.meta import meta_gradients
from prism_jax.losses.chamfer import primary_loss
from prism_jax.losses.depth import depth_supervised
from prism_jax.models.prism import predict, prepare_input
from tests.trees import as_double, dot, row

pytestmark = pytest.mark.slow

# Gradients stop at the PCA anchors of the normals and at the scale of the transport's
# entropy, which finite differences see move: neither has a weight here.
LOGITS, SCALES = (-1e9, 0.3, -0.4), (0.5, 0.02, 7.0)
SMOOTH = {"lambda_transport": 0.0, "depth_weight": 2.0, "step_size": 0.01}
META = MetaConfig(
    beta_0=0.3,
    lambda_aux=10.0,
    weight_rule="meta",
    rehearse_depth=True,
    learn_steps=True,
    learn_auxiliary=True,
)
# What acts through the inner loop alone moves little, and far from any kink.
STEPS = {"point_encoder": 1e-8, "decoder": 1e-8, "refiner": 1e-8}
STEPS |= {"depth_encoder": 1e-6, "auxiliary": 1e-6, "logits": 1e-5, "log_steps": 1e-5}


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config.with_adapt(**SMOOTH, clip_norm=1.0)


@pytest.fixture(scope="module")
def variables(minimal_variables, double):
    """Not fresh ones: their biases of zero leave many a ReLU exactly at its kink."""
    own = {"logits": jnp.array(LOGITS), "scales": jnp.array(SCALES)}
    weighting = {**minimal_variables["weighting"], **own}
    return as_double({**minimal_variables, "weighting": weighting})


@pytest.fixture(scope="module")
def frames(config, tiny_frames, double):
    """Two frames, and their complete clouds."""
    partials, cameras = jax.tree.map(lambda leaf: leaf[:2], as_double(tiny_frames))
    key = jax.random.key(config.adapt.seed)
    prepare = jax.vmap(lambda p, c: prepare_input(p, c, key, config.model))
    clouds = np.random.default_rng(2).uniform(-0.8, 0.8, (2, 96, 3))
    return jax.jit(prepare)(partials, cameras), jnp.asarray(clouds)


@pytest.fixture(scope="module")
def evaluate(config, frames, quick_jit):
    """``evaluate(variables)``: gradients and terms."""
    run = quick_jit(lambda v, f, c: meta_gradients(v, f, c, config, META))
    return lambda variables: jax.device_get(run(variables, *frames))


def without_step(variables):
    """What the encoders do not adapt with."""
    weighting = variables["weighting"]
    none = jax.tree.map(lambda size: size - 1e9, weighting["log_steps"])
    return {**variables, "weighting": {**weighting, "log_steps": none}}


@pytest.mark.parametrize("name", STEPS)
def test_gradients_against_finite_differences(evaluate, variables, name):
    """Decoder and refiner without a step, in which Eq. 12 holds them fixed."""
    if name in ("decoder", "refiner"):
        variables = without_step(variables)
    kind = "weighting" if name in variables["weighting"] else "params"
    rng = np.random.default_rng(0)
    own, step = variables[kind][name], STEPS[name]
    direction = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), own)

    def at(sign):
        moved = jax.tree.map(lambda p, d: p + sign * step * d, own, direction)
        _, terms = evaluate({**variables, kind: {**variables[kind], name: moved}})
        adapted = float(terms.adapted)
        if name in ("decoder", "refiner"):
            return float(terms.refined) if name == "refiner" else 0.7 * adapted
        if name.endswith("encoder"):
            adapted += 10.0 * float(terms.losses.objective)
        return 0.7 * adapted + 0.3 * float(terms.zero_step)

    gradients, _ = evaluate(variables)
    found = dot(gradients[kind][name], direction)
    assert abs(found) > 0
    np.testing.assert_allclose((at(1) - at(-1)) / (2 * step), found, rtol=1e-5)


def test_terms_are_those_of_the_network(evaluate, variables, frames, config, quick_jit):
    """Before a step; with one the adapted completion is another."""

    @quick_jit
    def of_frame(frame, complete):
        made = predict(variables, frame, config.model)
        refined = depth_supervised(made.points, complete, frame.view)
        return primary_loss(made.stages, complete, "l1"), refined

    primary, refined = np.mean([of_frame(*row(frames, i)) for i in range(2)], axis=0)
    _, terms = evaluate(without_step(variables))
    np.testing.assert_allclose(terms.adapted, primary, rtol=1e-11)
    np.testing.assert_allclose(terms.refined, refined, rtol=1e-11)
    _, terms = evaluate(variables)
    np.testing.assert_allclose(terms.zero_step, primary, rtol=1e-11)
    assert abs(terms.adapted - primary) > 1e-5
