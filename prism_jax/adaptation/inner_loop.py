"""Gradient steps on parameters, unrolled, so that they can be differentiated too."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jaxtyping import Array, Float

Params = TypeVar("Params")
Aux = Any


def unroll(
    loss_fn: Callable[[Params], tuple[Float[Array, ""], Aux]],
    params: Params,
    step_size: float | Float[Array, ""],
    num_steps: int,
) -> tuple[Params, tuple[Float[Array, " K"], Aux]]:
    """``num_steps`` of ``params - step_size * grad(loss_fn)(params)``.

    ``loss_fn`` returns the loss and anything else worth keeping. Returns the adapted
    parameters, and the losses and extras *before* each step, stacked. The body is
    traced once, whatever the number of steps. Differentiable in ``params``,
    ``step_size`` and all that ``loss_fn`` closes over, to second order (MAML, Finn et
    al., ICML 2017).
    """
    value_and_grad = jax.value_and_grad(loss_fn, has_aux=True)

    def step(params: Params, _: None):
        (loss, aux), grads = value_and_grad(params)
        moved = jax.tree.map(lambda p, g: p - step_size * g, params, grads)
        return moved, (loss, aux)

    return jax.lax.scan(step, params, None, length=num_steps)
