"""Whether a step that lowers a label-free loss also lowers the error.

Measured by the cosines of their gradients in the point encoder, and by the error after
a step along each gradient.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from tqdm import tqdm

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import test_time_objective
from prism_jax.data.ordering import first_points
from prism_jax.data.pipeline import with_partial
from prism_jax.data.source import Source
from prism_jax.evaluation.bootstrap import mean_intervals
from prism_jax.evaluation.protocol import (
    Protocol,
    observed,
    side_by_side,
    workspace_for,
)
from prism_jax.evaluation.tables import percent, table_lines, title
from prism_jax.geometry.neighbors import nearest
from prism_jax.geometry.sampling import resample
from prism_jax.geometry.workspace import Workspace
from prism_jax.losses.chamfer import chamfer
from prism_jax.models.prism import NetworkInput, hold_decoding, predict, prepare_input
from prism_jax.models.variables import Variables
from prism_jax.observation.observation import observe

ERROR = "CD-L2 to the complete cloud"
ORACLE = "that error itself, which nobody knows"
LOSSES = (
    "depth consistency, Eq. 4",
    "normals, Eq. 5",
    "denoising, Eq. 6",
    "alignment, Eq. 9",
    "measured points to the completion",
    "hidden measured points to the completion of the rest",
)
HIDDEN = 0.25
"""Share of the partial that is hidden: the points nearest to one of them."""

NUM_COMPLETE = 2048


def gradient_agreement(
    config: PrismConfig,
    variables: Variables,
    source: Source,
    protocol: Protocol,
    limit: int | None = None,
    batch_size: int = 20,
) -> dict[str, Any]:
    """Cosines between the gradients of `LOSSES` and that of `ERROR`, as JSON, and the
    error after a step against each gradient.

    Both are taken for each example at the weights' own completion of it, with the
    decoder's samples and neighbours fixed as adaptation fixes them. A cosine has its
    ``mean`` over examples, a 95 % bootstrap ``interval`` over objects, and the share of
    examples where it is ``positive``. A step has the length ``step_length``;
    ``change`` is the mean relative rise of the error after it, with a
    ``change_interval``. `ORACLE` steps against the gradient of the error itself. A loss
    without a gradient has cosine 0 and moves nothing.
    """
    count = len(source) if limit is None else min(limit, len(source))
    size = min(batch_size, count)
    followed = jax.jit(jax.vmap(cosines_and_changes(config), (None, 0, 0, 0, 0)))
    rows = []
    for start in tqdm(range(0, count, size), desc="gradients", unit="batch"):
        indices = np.arange(start, start + size) % count
        framed = [_framed(source, int(index), protocol) for index in indices]
        arrays = (jnp.asarray(np.stack(one)) for one in zip(*framed, strict=True))
        keys = jax.vmap(jax.random.key)(indices)
        rows.extend(np.asarray(followed(variables, *arrays, keys))[: count - start])
    values = np.array(rows, np.float64)
    objects = source.objects[:count]
    means = values.mean(0)
    low, high = np.array(mean_intervals(values.reshape(count, -1), objects)).reshape(
        2, *means.shape
    )
    return {
        "num_examples": count,
        "num_objects": int(objects[-1]) + 1,
        "error": ERROR,
        "step_length": config.adapt.step_size,
        "losses": {
            name: {
                "mean": float(means[0, i]),
                "interval": [float(low[0, i]), float(high[0, i])],
                "positive": float((values[:, 0, i] > 0).mean()),
                "change": float(means[1, i]),
                "change_interval": [float(low[1, i]), float(high[1, i])],
            }
            for i, name in enumerate((*LOSSES, ORACLE))
        },
    }


def _framed(
    source: Source, index: int, protocol: Protocol
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Partial, sensor's place and complete cloud in the workspace."""
    example = with_partial(source[index])
    assert example.complete is not None
    complete = first_points(example.complete, NUM_COMPLETE, example.ordered)
    complete = workspace_for(example, protocol).to_unit(complete)
    (partial,), (eye,) = side_by_side([observed(example, protocol)])
    return partial, eye, np.asarray(complete, np.float32)


def cosines_and_changes(
    config: PrismConfig,
) -> Callable[[Variables, Array, Array, Array, Array], Float[Array, "2 L"]]:
    """A pure function that measures one example.

    It takes variables, partial (N, 3), eye (3,) and complete (M, 3), all three in the
    unit workspace, and a key that chooses what is hidden. It returns the cosines of
    `LOSSES` and `ORACLE`, and by what share a step against each raises the error.
    """

    def prepared(variables: Variables, partial: Array, eye: Array) -> NetworkInput:
        camera = observe(partial, eye, Workspace.unit()).camera
        key = jax.random.key(config.adapt.seed)
        inputs = prepare_input(partial, camera, key, config.model)
        return hold_decoding(variables, inputs, config.model)

    def followed(
        variables: Variables, partial: Array, eye: Array, complete: Array, key: Array
    ) -> Float[Array, "2 L"]:
        inputs = prepared(variables, partial, eye)
        hidden, left = _parted(partial, key)
        rest = prepared(variables, left, eye)
        params = variables["params"]

        start, unravel = ravel_pytree(params["point_encoder"])

        def values(flat: Float[Array, " P"]) -> Float[Array, " terms"]:
            own = {**variables, "params": {**params, "point_encoder": unravel(flat)}}
            losses, prediction = test_time_objective(own, inputs, config)
            completed_rest = predict(own, rest, config.model)
            terms = (
                losses.depth_consistency,
                *losses.auxiliary,
                nearest(partial, prediction.points)[0].mean(),
                nearest(hidden, completed_rest.points)[0].mean(),
                chamfer(prediction.points, complete),
            )
            return jnp.stack(terms)

        return agreement(values, start, config.adapt.step_size)

    return followed


def agreement(
    values: Callable[[Float[Array, " P"]], Float[Array, " L"]],
    start: Float[Array, " P"],
    step_length: float,
) -> Float[Array, "2 L"]:
    """Of several functions, the last of which is the error: the cosines of their
    gradients with the error's, and by what share a step of this length against each
    raises the error. Without a gradient both are 0."""
    rows = jax.jacrev(values)(start)
    norms = jnp.sqrt((rows**2).sum(-1, keepdims=True))
    units = jnp.where(norms > 0, rows / jnp.where(norms > 0, norms, 1), 0)
    moved = jax.lax.map(lambda unit: values(start - step_length * unit)[-1], units)
    return jnp.stack([units @ units[-1], moved / values(start)[-1] - 1])


def _parted(partial: Float[Array, "N 3"], key: Array) -> tuple[Array, Array]:
    """The `HIDDEN` points around one of the partial's, and the rest, resampled to as
    many points as the whole."""
    count = len(partial)
    around = partial[jax.random.randint(key, (), 0, count)]
    order = jnp.argsort(((partial - around) ** 2).sum(-1))
    hidden = int(HIDDEN * count)
    return partial[order[:hidden]], resample(partial[order[hidden:]], count)


def agreement_markdown(result: Mapping[str, Any]) -> str:
    """What names the result of `gradient_agreement`, and its rows."""
    rows = []
    for label, row in result["losses"].items():
        low, high = row["interval"]
        mean = f"{row['mean']:+.3f} [{low:+.3f}, {high:+.3f}]"
        change = percent(row["change"], row["change_interval"])
        rows.append([label, mean, f"{100 * row['positive']:.0f} %", change])
    head = ["gradient of", f"cosine with that of {result['error']}", "positive"]
    head.append(f"the error after a step of length {result['step_length']:g}")
    return "\n".join([f"{title(result)}\n", *table_lines(head, rows), ""])
