"""Gradient steps on parameters, unrolled, so that they can be differentiated too."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from prism_jax.adaptation.config import AdaptConfig
from prism_jax.models.variables import Variables, pop_encoders

Params = TypeVar("Params")
Aux = Any
StepSizes = Any
"""One step size for all parameters, or a tree of them that has the parameters' tree as
its own or begins as it does: a step size then holds for all below its place."""


def unroll(
    loss_fn: Callable[[Params], tuple[Float[Array, ""], Aux]],
    params: Params,
    step_sizes: StepSizes,
    num_steps: int,
    first_order: bool = False,
    clip_norm: float = 0.0,
) -> tuple[Params, tuple[Float[Array, " K"], Aux]]:
    """``num_steps`` of ``params - step_sizes * grad(loss_fn)(params)``.

    A gradient whose global norm is above ``clip_norm``, if that is not zero, is scaled
    down to it. ``loss_fn`` returns the loss and anything else worth keeping. Returns
    the adapted parameters, and the losses and extras *before* each step, stacked.
    Differentiable in all that enters, to second order (MAML, Finn et al., ICML 2017);
    with ``first_order`` the gradients count as constants.
    """
    value_and_grad = jax.value_and_grad(loss_fn, has_aux=True)

    def step(params: Params, _: None):
        (loss, aux), grads = value_and_grad(params)
        moved = descend(params, grads, step_sizes, first_order, clip_norm)
        return moved, (loss, aux)

    return jax.lax.scan(step, params, None, length=num_steps)


def descend(
    params: Params,
    grads: Params,
    step_sizes: StepSizes,
    first_order: bool = False,
    clip_norm: float = 0.0,
) -> Params:
    """One step of plain gradient descent, as `unroll` makes it."""
    if first_order:
        grads = jax.lax.stop_gradient(grads)
    if clip_norm:
        # As one vector: of a sum over a hundred leaves, and of its derivative, XLA on a
        # CPU computes every term again wherever the gradients are used.
        flat, unravel = ravel_pytree(grads)
        # The norm's derivative at zero would not be finite.
        norm = jnp.sqrt(jnp.maximum((flat**2).sum(), clip_norm**2))
        grads = unravel(flat * (clip_norm / norm))

    def below(step_size: Any, params: Params, grads: Params) -> Params:
        return jax.tree.map(lambda p, g: p - step_size * g, params, grads)

    return jax.tree.map(below, step_sizes, params, grads)


def step_sizes(variables: Variables, config: AdaptConfig) -> StepSizes:
    """Of every encoder parameter: the configuration's times what was learned.
    BatchNorm's scales and biases stay where they are if ``adapt_norm`` is off."""
    encoders, _ = pop_encoders(variables)
    sizes = jax.tree.map(
        lambda log_step: config.step_size * jnp.exp(log_step),
        variables["weighting"]["log_steps"],
    )
    if config.adapt_norm:
        return sizes

    def of_parameter(path: tuple, _: Array) -> Array | float:
        names = [step.key for step in path]
        is_norm = any(name.endswith("norm") for name in names)
        return 0.0 if is_norm else sizes[names[0]][names[1]]

    return jax.tree_util.tree_map_with_path(of_parameter, encoders)
