"""The variables of PRISM, and the encoder subtree that adaptation changes.

``{"params": {point_encoder, depth_encoder, decoder, refiner, auxiliary},
"batch_stats": {point_encoder, depth_encoder, decoder}, "weighting": {logits,
scales}}``: the last holds the learned eta of Eq. 11 and the losses' own scales.
"""

from typing import Any

Variables = dict[str, Any]

ENCODERS = ("point_encoder", "depth_encoder")
"""The parts that test-time adaptation moves."""


def pop_encoders(variables: Variables) -> tuple[Variables, Variables]:
    """The two encoders' parameters, and the variables without them."""
    params = variables["params"]
    encoders = {name: params[name] for name in ENCODERS}
    rest = {name: tree for name, tree in params.items() if name not in ENCODERS}
    return encoders, {**variables, "params": rest}


def put_encoders(encoders: Variables, rest: Variables) -> Variables:
    """The inverse of `pop_encoders`, with these encoders in the place of theirs."""
    return {**rest, "params": {**rest["params"], **encoders}}


def part(variables: Variables, *path: str) -> Variables:
    """One module's own variables, to be given to its ``apply``."""
    own = {}
    for collection in ("params", "batch_stats"):
        tree = variables[collection]
        for name in path:
            tree = tree.get(name, {})
        if tree:
            own[collection] = tree
    return own
