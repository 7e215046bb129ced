"""Meta-training, stage B: Eq. 12 over batches of frames, on all devices."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jax.scipy.special import entr
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.meta import learned_part, meta_gradients, put_learned
from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.data.pipeline import Batch
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import chamfer
from prism_jax.losses.weighting import BRANCHES, update_scale
from prism_jax.models.variables import Variables
from prism_jax.preprocessing.observation import framed_view
from prism_jax.training.config import MetaTrainConfig
from prism_jax.training.inputs import inputs_of
from prism_jax.training.optimisers import optimiser
from prism_jax.training.parallel import DATA, data_mesh
from prism_jax.training.phase import Phase, TrainState, averaged, steps_of

WEIGHTS = (*(f"weight_{name}" for name in BRANCHES), "weight_entropy")
TERMS = ("zero_step", *Losses._fields, "refined", *WEIGHTS, "adapted")
SCORES = ("unadapted", "accepted", "adapted")


def meta_phase(
    variables: Variables, config: PrismConfig, training: MetaTrainConfig, seed: int
) -> Phase:
    """Episodes from these variables on (Eq. 11, 12).

    Encoders and decoder, refiner, auxiliary modules, logits and step sizes each have an
    optimiser of their own, where they learn. All else stays as it is, but for the
    scales of Eq. 11: they are measured again, as those of the branches' own training
    had not settled. The score is CD-L2 after test-time adaptation (`Batch.scale`).
    """
    check_meta(training)
    optimisers = _optimisers(training)
    counts = jnp.array([name in training.method.branches for name in BRANCHES])
    logits = jnp.where(counts, variables["weighting"]["logits"], -jnp.inf)
    scales = jnp.zeros(len(BRANCHES))
    weighting = {**variables["weighting"], "logits": logits, "scales": scales}
    variables = {**variables, "weighting": weighting}
    learned = learned_part(variables, training.method)
    average = variables if training.average_decay else None
    key = jax.random.key(seed)
    sizes = training.num_samples, training.batch_size, training.num_complete
    start = TrainState(jnp.int32(0), variables, optimisers.init(learned), average)
    step, validate = _step(config, training, optimisers, key), _validation(config)
    return Phase("meta", *sizes, start, step, validate, TERMS, SCORES)


def check_meta(training: MetaTrainConfig) -> None:
    """Raises InputError for settings under which something would not be learned."""
    steps_of("meta", training.num_samples, training.batch_size)
    method = training.method
    for name, needs_second_order in (
        ("weight_rule=meta", method.weight_rule == "meta"),
        ("learn_auxiliary", method.learn_auxiliary),
    ):
        if method.first_order and needs_second_order:
            fault = f"first-order gradients cannot train {name}"
            raise InputError("meta.method.first_order", fault, "omit one of them")


def _optimisers(training: MetaTrainConfig) -> optax.GradientTransformation:
    """One for each kind of parameter, by its place in `learned_part`."""
    num_steps = steps_of("meta", training.num_samples, training.batch_size)
    kind = training.optimiser
    make = optax.sgd if kind == "sgd" else optax.adam
    limits = training.final_rate, training.warmup_steps, training.clip_norm
    return optax.partition(
        {
            "backbone": optimiser(kind, training.learning_rate, num_steps, *limits),
            "auxiliary": optimiser(kind, training.auxiliary_rate, num_steps, *limits),
            "refiner": optimiser(kind, training.refiner_rate, num_steps, *limits),
            "logits": make(training.weight_rate),
            "log_steps": optax.adam(training.step_rate),
        },
        lambda learned: {
            "params": {
                name: name if name in ("auxiliary", "refiner") else "backbone"
                for name in learned["params"]
            },
            "weighting": {name: name for name in learned["weighting"]},
        },
    )


def _step(
    config: PrismConfig,
    training: MetaTrainConfig,
    optimisers: optax.GradientTransformation,
    key: PRNGKeyArray,
) -> Callable[[TrainState, Batch], tuple[TrainState, Float[Array, " L"]]]:
    method = training.method

    def device_step(state: TrainState, batch: Batch):
        """What every device does with its share, and then with the mean of all."""
        variables = state.variables
        now = jax.random.fold_in(key, state.step)

        def gradients(batch: Batch):
            # All alike, whatever the devices.
            inputs = inputs_of(batch, now, config.model)
            complete = jnp.asarray(batch.complete)
            return meta_gradients(variables, inputs, complete, config, method)

        found = _in_parts(gradients, batch, training.at_once)
        grads, terms = jax.lax.pmean(found, DATA)
        learned = learned_part(variables, method)
        updates, opt_state = optimisers.update(grads, state.opt_state, learned)
        moved: Variables = optax.apply_updates(learned, updates)  # pyright: ignore
        variables = put_learned(moved, variables)
        weighting = variables["weighting"]
        weighting["scales"] = update_scale(weighting["scales"], terms.losses.auxiliary)
        average = averaged(state.average, variables, training.average_decay)
        if average is not None:  # the scales are averages, and start unmeasured, at 0
            average["weighting"]["scales"] = weighting["scales"]
        state = TrainState(state.step + 1, variables, opt_state, average)
        weights = jax.nn.softmax(weighting["logits"])
        losses = (terms.zero_step, *terms.losses, terms.refined)
        measured = [*losses, *weights, entr(weights).sum(), terms.adapted]
        return state, jnp.stack(measured)

    return jax.jit(
        jax.shard_map(
            device_step,
            mesh=data_mesh(),
            in_specs=(PartitionSpec(), PartitionSpec(DATA)),
            out_specs=PartitionSpec(),
            check_vma=False,
        )
    )


def _in_parts(fn: Callable[[Batch], tuple], batch: Batch, at_once: int) -> tuple:
    """The mean of a function's results over equal parts of a batch, in turn."""
    share = batch.partial.shape[0]
    count = share // math.gcd(share, at_once)
    if count == 1:
        return fn(batch)
    parts = jax.tree.map(lambda x: x.reshape(count, -1, *x.shape[1:]), batch)
    shapes = jax.eval_shape(fn, jax.tree.map(lambda x: x[0], parts))
    zeros = jax.tree.map(jnp.zeros_like, shapes)

    def add(total: tuple, part: Batch):
        return jax.tree.map(jnp.add, total, fn(part)), None

    total, _ = jax.lax.scan(add, zeros, parts)
    return jax.tree.map(lambda x: x / count, total)


def _validation(
    config: PrismConfig,
) -> Callable[[Variables, Batch], Float[Array, "B S"]]:
    """CD-L2 without and with adaptation, and whether that was accepted."""
    complete_frame = make_adapt(config)

    @jax.jit
    def validate(variables: Variables, batch: Batch):
        def one(row: Batch):
            camera = framed_view(row.partial, row.eye)
            done = complete_frame(variables, row.partial, camera, row.visibility)
            complete, unit = jnp.asarray(row.complete), row.scale**2
            before = chamfer(done.before, complete) * unit
            after = chamfer(done.points, complete) * unit
            return jnp.stack([before, done.accepted.astype(before.dtype), after])

        return jax.vmap(one)(jax.tree.map(jnp.asarray, batch))

    return validate
