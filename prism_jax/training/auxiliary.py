"""The last phase of pretraining: refiner, depth encoder and auxiliary branches.

The backbone is finished and frozen. The refiner learns from Eq. 3 through its own
optimiser. The depth stream learns to give the tokens that the point stream gives; the
point stream's tokens are the fixed side of that, or both would collapse to a constant.
"""

import functools

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import auxiliary_losses
from prism_jax.data.pipeline import Batch
from prism_jax.losses.alignment import manifold_matching, transport_alignment
from prism_jax.losses.chamfer import chamfer
from prism_jax.losses.depth import depth_supervised
from prism_jax.losses.weighting import BRANCHES, update_scale
from prism_jax.models import prism
from prism_jax.models.depth_encoder import DepthEncoder
from prism_jax.models.variables import Variables, apply_training, part
from prism_jax.training.config import PretrainConfig
from prism_jax.training.inputs import inputs_of
from prism_jax.training.optimisers import optimiser
from prism_jax.training.phase import Phase, TrainState, steps_of

TRAINED = ("refiner", "depth_encoder", "auxiliary")  # the parts that learn


def auxiliary_phase(
    variables: Variables, config: PrismConfig, training: PretrainConfig, seed: int
) -> Phase:
    """Everything but the backbone, on the losses of Eq. 3, 5, 6 and 9."""
    num_steps = steps_of("auxiliary", training.auxiliary_samples, training.batch_size)
    limits = training.warmup_steps, training.clip_norm
    adam = optimiser("adam", training.auxiliary_rate, num_steps, 0.01, *limits)
    # The refiner's gradient is clipped on its own.
    both = optax.partition(
        {"refiner": adam, "branches": adam},
        {name: "refiner" if name == "refiner" else "branches" for name in TRAINED},
    )
    trained = {name: variables["params"][name] for name in TRAINED}
    start = TrainState(jnp.int32(0), variables, both.init(trained))
    key = jax.random.key(seed)
    sizes = training.auxiliary_samples, training.batch_size, training.num_complete
    step, validate = _step(config, both, key), _validation(config, key)
    told = ("refined", *BRANCHES), ("unrefined", "refined", "losses")
    return Phase("auxiliary", *sizes, start, step, validate, *told)


def _step(config: PrismConfig, both: optax.GradientTransformation, key: PRNGKeyArray):
    encoder = DepthEncoder(config.model.auxiliary)

    def loss_fn(trained, variables, batch, key):
        variables = {**variables, "params": {**variables["params"], **trained}}
        keys = jax.random.split(key, batch.partial.shape[0])
        inputs = inputs_of(batch, keys, config.model)
        own, image = part(variables, "depth_encoder"), (inputs.depth, inputs.depth_mask)
        depth_tokens, statistics = apply_training(encoder, own, *image)
        terms, measured, _ = _terms(variables, inputs, depth_tokens, batch, config)
        return terms.sum(), (terms, measured.mean(0), statistics)

    @jax.jit
    def step(state: TrainState, batch: Batch):
        variables = state.variables
        params, weighting = variables["params"], variables["weighting"]
        trained = {name: params[name] for name in TRAINED}
        now = jax.random.fold_in(key, state.step)
        grads, (terms, measured, statistics) = jax.grad(loss_fn, has_aux=True)(
            trained, variables, batch, now
        )
        updates, opt_state = both.update(grads, state.opt_state, trained)
        moved: Variables = optax.apply_updates(trained, updates)  # pyright: ignore
        scales = update_scale(weighting["scales"], measured)
        variables = {
            "params": {**params, **moved},
            "batch_stats": {**variables["batch_stats"], "depth_encoder": statistics},
            "weighting": {**weighting, "scales": scales},
        }
        return TrainState(state.step + 1, variables, opt_state), terms

    return step


def _validation(config: PrismConfig, key: PRNGKeyArray):
    """CD-L2 before and after the refiner, and the sum of the phase's losses over the
    whole batch: Eq. 7 looks at all of its tokens."""

    @jax.jit
    def validate(variables: Variables, batch: Batch):
        keys = jax.random.split(key, batch.partial.shape[0])
        inputs = inputs_of(batch, keys, config.model)
        read = functools.partial(prism.read_depth, config=config.model)
        depth_tokens = jax.vmap(read, (None, 0))(variables, inputs)
        terms, _, predictions = _terms(variables, inputs, depth_tokens, batch, config)
        complete = jnp.asarray(batch.complete)
        scale = jnp.asarray(batch.scale) ** 2
        clouds = (predictions.stages[-1], predictions.points)
        distances = [jax.vmap(chamfer)(cloud, complete) * scale for cloud in clouds]
        return jnp.stack([*distances, jnp.broadcast_to(terms.sum(), scale.shape)], -1)

    return validate


def _terms(
    variables: Variables,
    inputs: prism.NetworkInput,
    depth_tokens: Float[Array, "B n C"],
    batch: Batch,
    config: PrismConfig,
) -> tuple[Float[Array, "4"], Float[Array, "B 3"], prism.Prediction]:
    """Losses of refiner, normals, denoising and alignment; L_aux example by example. In
    training, Eq. 7 takes its statistics over the tokens of the whole batch (gap 6)."""

    def one(inputs: prism.NetworkInput, tokens: Array, complete: Array):
        prediction = prism.predict(variables, inputs, config.model)
        refined = depth_supervised(prediction.points, complete, inputs.view)
        fixed = prediction._replace(points=jax.lax.stop_gradient(prediction.points))
        seen = prism.branches(variables, inputs, fixed, tokens, config.model)
        seen = seen._replace(tokens_3d=jax.lax.stop_gradient(seen.tokens_3d))
        auxiliary = auxiliary_losses(inputs, fixed, seen, config.adapt)
        pair = seen.tokens_3d, seen.tokens_depth
        transport = transport_alignment(*pair, config.adapt.transport_epsilon)
        return refined, auxiliary, transport, seen, prediction

    complete = jnp.asarray(batch.complete)
    refined, auxiliary, transport, seen, predictions = jax.vmap(one)(
        inputs, depth_tokens, complete
    )
    width = config.model.auxiliary.token_features
    tokens = seen.tokens_3d.reshape(-1, width), seen.tokens_depth.reshape(-1, width)
    matching = manifold_matching(*tokens, config.adapt.lambda_sigma)
    align = matching + config.adapt.lambda_transport * transport.mean()
    normal, denoise, _ = auxiliary.mean(0)
    terms = jnp.stack([refined.mean(), normal, denoise, align])
    return terms, jax.lax.stop_gradient(auxiliary), predictions
