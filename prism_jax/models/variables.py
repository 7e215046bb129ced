"""The variables of PRISM, and the encoder subtree that adaptation changes.

``{"params": {point_encoder, depth_encoder, decoder, refiner, auxiliary},
"batch_stats": {point_encoder, depth_encoder, decoder}, "weighting": {logits, scales,
log_steps}}``: the last holds the learned eta of Eq. 11, the losses' own scales, and for
each module of the encoders the logarithm of its learned step size, as a multiple of the
configuration's.
"""

import contextlib
from typing import Any

import flax.linen as nn
import jax

Variables = dict[str, Any]

ENCODERS = ("point_encoder", "depth_encoder")
"""The parts that test-time adaptation moves."""


def on_cpu() -> contextlib.AbstractContextManager:
    """Where fresh variables are made: a seed then means the same everywhere, and a GPU
    would take minutes to compile. The default device where JAX has no CPU."""
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:
        return contextlib.nullcontext()


def pop_encoders(variables: Variables) -> tuple[Variables, Variables]:
    """The two encoders' parameters, and the variables without them."""
    params = variables["params"]
    encoders = {name: params[name] for name in ENCODERS}
    rest = {name: tree for name, tree in params.items() if name not in ENCODERS}
    return encoders, {**variables, "params": rest}


def put_encoders(encoders: Variables, rest: Variables) -> Variables:
    """The inverse of `pop_encoders`, with these encoders in the place of theirs."""
    return {**rest, "params": {**rest["params"], **encoders}}


def apply(
    module: nn.Module, variables: Variables, *inputs: Any, **settings: Any
) -> Any:
    """What a module makes of its inputs, with BatchNorm statistics as they are."""
    return module.apply(variables, *inputs, **settings)


def apply_training(
    module: nn.Module, variables: Variables, *inputs: Any, **settings: Any
) -> tuple[Any, Variables]:
    """What a module makes of its inputs with statistics of the batch, and the updated
    running statistics."""
    settings |= {"train": True, "mutable": ["batch_stats"]}
    output, updated = apply(module, variables, *inputs, **settings)
    return output, updated.get("batch_stats", {})


def part(variables: Variables, *path: str) -> Variables:
    """One module's own variables, to be given to `apply`."""
    own = {}
    for collection in ("params", "batch_stats"):
        tree = variables[collection]
        for name in path:
            tree = tree.get(name, {})
        if tree:
            own[collection] = tree
    return own
