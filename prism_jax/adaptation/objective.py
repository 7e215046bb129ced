"""The label-free objective of one cloud, Eq. 11 and Eq. 13."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from prism_jax.adaptation.config import AdaptConfig, PrismConfig
from prism_jax.geometry.visibility import Visibility, seen_by, spacing_of
from prism_jax.losses.alignment import alignment_loss
from prism_jax.losses.denoise import denoise_loss
from prism_jax.losses.depth import depth_error
from prism_jax.losses.learned import error_clues
from prism_jax.losses.normal import normal_loss
from prism_jax.losses.visibility import contradiction, keep_loss, visibility_loss
from prism_jax.losses.weighting import BRANCHES, weighted_auxiliary
from prism_jax.models.error_head import LEARNED, log_errors
from prism_jax.models.prism import (
    Branches,
    NetworkInput,
    Prediction,
    branches,
    hold_decoding,
    predict,
    read_depth,
)
from prism_jax.models.variables import Variables, pop_encoders, put_encoders

TOLERANCE = 2.0
"""In spacings of the network's input: a predicted point that much nearer than all that
was measured about its pixel would have hidden it. Chosen on `novel`
(docs/findings.md)."""

BALANCED = ("depth_consistency", *BRANCHES, "visibility")
"""The terms that have a norm of their own (`AdaptConfig.balance`); after them the
learned one, if it has a weight."""


class Losses(NamedTuple):
    """The terms of Eq. 13 as they are, before scales and weights, and their sum.

    `visibility`, `keep` and `learned` are not of the paper; they are None where they
    have no weight.
    """

    objective: Float[Array, "*steps"]
    depth_consistency: Float[Array, "*steps"]
    normal: Float[Array, "*steps"]
    denoise: Float[Array, "*steps"]
    align: Float[Array, "*steps"]
    visibility: Float[Array, "*steps"] | None = None
    keep: Float[Array, "*steps"] | None = None
    learned: Float[Array, "*steps"] | None = None

    def named(self) -> dict[str, Float[Array | np.ndarray, "*steps"]]:
        """All that there are, by name."""
        return {k: v for k, v in self._asdict().items() if v is not None}

    @property
    def auxiliary(self) -> Float[Array, "*steps K"]:
        """Those of Eq. 11, in the order of `BRANCHES`."""
        return jnp.stack([getattr(self, name) for name in BRANCHES], -1)


COMMON = tuple(name for name in Losses._fields if name not in Losses._field_defaults)
"""The terms that there always are, with the objective."""


def _normal(
    inputs: NetworkInput, prediction: Prediction, seen: Branches, config: AdaptConfig
) -> Float[Array, ""]:
    """Eq. 5."""
    return normal_loss(
        seen.normals,
        prediction.points,
        config.lambda_smooth,
        config.normal_neighbors,
        stride=config.normal_stride,
    )


def _denoise(
    inputs: NetworkInput, prediction: Prediction, seen: Branches, config: AdaptConfig
) -> Float[Array, ""]:
    """Eq. 6."""
    denoised = inputs.perturbed + seen.offsets
    return denoise_loss(denoised, inputs.upsampled, seen.offsets, config.lambda_offset)


def _align(
    inputs: NetworkInput, prediction: Prediction, seen: Branches, config: AdaptConfig
) -> Float[Array, ""]:
    """Eq. 9."""
    return alignment_loss(
        seen.tokens_3d,
        seen.tokens_depth,
        config.lambda_sigma,
        config.lambda_transport,
        config.transport_epsilon,
    )


_LOSSES = {"normal": _normal, "denoise": _denoise, "align": _align}


def auxiliary_losses(
    inputs: NetworkInput, prediction: Prediction, seen: Branches, config: AdaptConfig
) -> Float[Array, " K"]:
    """The losses of one cloud's branches, in the order of `BRANCHES`."""
    arguments = (inputs, prediction, seen, config)
    return jnp.stack([_LOSSES[name](*arguments) for name in BRANCHES])


def test_time_objective(
    variables: Variables, inputs: NetworkInput, config: PrismConfig
) -> tuple[Losses, Prediction]:
    """L_TTA of Eq. 13, its terms, and the prediction that they judge.

    Each auxiliary loss is divided by its scale from training (gap 15) and weighted by
    softmax(eta*). Where inputs are held with norms (`hold`), every term is divided by
    that of its own gradient instead. Differentiable in the encoders' parameters.
    """
    terms, prediction = _terms(variables, inputs, config)
    settings, weighting = config.adapt, variables["weighting"]
    scales, consistency = weighting["scales"], terms.consistency
    norms = inputs.norms
    if norms is not None:
        # As a scale of zero does, a norm of zero leaves a term undivided.
        norms = jnp.where(norms > 0, norms, 1.0)
        consistency, scales = consistency / norms[0], norms[1 : 1 + len(BRANCHES)]
    weighted = weighted_auxiliary(weighting["logits"], terms.auxiliary, scales)
    objective = settings.depth_weight * consistency
    if settings.auxiliary_weight:
        objective += settings.auxiliary_weight * weighted
    if terms.visibility is not None:
        beside = settings.visibility_weight * terms.visibility
        beside += settings.keep_weight * terms.keep
        place = BALANCED.index("visibility")
        objective += beside if norms is None else beside / norms[place]
    if terms.learned is not None:
        learned = settings.learned_weight * terms.learned
        objective += learned if norms is None else learned / norms[-1]
    extra = (terms.visibility, terms.keep, terms.learned)
    return Losses(objective, terms.consistency, *terms.auxiliary, *extra), prediction


class _Terms(NamedTuple):
    """Those of `Losses`, with the auxiliary ones as an array."""

    consistency: Float[Array, ""]
    auxiliary: Float[Array, " K"]
    visibility: Float[Array, ""] | None = None
    keep: Float[Array, ""] | None = None
    learned: Float[Array, ""] | None = None


def _terms(
    variables: Variables, inputs: NetworkInput, config: PrismConfig
) -> tuple[_Terms, Prediction]:
    """The terms of a prediction, and the prediction."""
    prediction = predict(variables, inputs, config.model)
    depth_features = read_depth(variables, inputs, config.model)
    seen = branches(variables, inputs, prediction, depth_features, config.model)
    auxiliary = auxiliary_losses(inputs, prediction, seen, config.adapt)
    points = prediction.points
    consistency = depth_error(
        points, inputs.reference, inputs.reference_mask, inputs.view
    )
    terms = _Terms(consistency, auxiliary)
    if config.adapt.learned_weight:
        terms = terms._replace(learned=learned_loss(variables, points, inputs, config))
    if not _looks(config.adapt):
        return terms, prediction
    keep = jnp.zeros(())
    if inputs.kept is not None:
        keep = keep_loss(points, inputs.kept, inputs.kept_mask)
    visibility = visibility_loss(points, _known(inputs, config), _tolerance(inputs))
    return terms._replace(visibility=visibility, keep=keep), prediction


def learned_loss(
    variables: Variables,
    points: Float[Array, "N 3"],
    inputs: NetworkInput,
    config: PrismConfig,
) -> Float[Array, ""]:
    """Mean error that the learned term expects of the points: of its logarithm.

    Differentiable in the points and in the term's parameters. Variables without a term
    raise ValueError.
    """
    if LEARNED not in variables["params"]:
        raise ValueError(
            "these weights have no learned term; leave adapt.learned_weight at 0, or "
            "fit one with experiments.learned_term"
        )
    known, eye = _known(inputs, config), inputs.view.position
    clues = error_clues(points, inputs.partial, known, eye)
    return jnp.mean(log_errors(variables["params"][LEARNED], clues))


def hold(
    variables: Variables, inputs: NetworkInput, config: PrismConfig
) -> NetworkInput:
    """The inputs with what the steps take over from the network as it is before them.

    How it decodes them (`prism_jax.models.prism.hold_decoding`); where the settings ask
    for it, its completion, with a mask of what the view allows of that, and the norms
    of each term's gradient in the encoders (`BALANCED`). No gradient passes.
    """
    inputs, settings = hold_decoding(variables, inputs, config.model), config.adapt
    variables = jax.lax.stop_gradient(variables)
    if _looks(settings) or settings.learned_weight:
        inputs = inputs._replace(visibility=_known(inputs, config))
    if settings.keep_weight:
        points = predict(variables, inputs, config.model).points
        against = contradiction(points, inputs.visibility, _tolerance(inputs))
        inputs = inputs._replace(kept=points, kept_mask=against == 0)
    if settings.balance:
        inputs = inputs._replace(norms=_gradient_norms(variables, inputs, config))
    return inputs


def _gradient_norms(
    variables: Variables, inputs: NetworkInput, config: PrismConfig
) -> Float[Array, " T"]:
    """Of each of `BALANCED`, zero for one without a weight; and of the learned term,
    if it has one."""
    encoders, rest = pop_encoders(variables)
    start, unravel = ravel_pytree(encoders)

    def values(flat: Float[Array, " P"]) -> Float[Array, " T"]:
        terms, _ = _terms(put_encoders(unravel(flat), rest), inputs, config)
        seen = jnp.zeros(()) if terms.visibility is None else terms.visibility
        learned = [] if terms.learned is None else [terms.learned]
        return jnp.stack([terms.consistency, *terms.auxiliary, seen, *learned])

    # One backward pass after the other needs no more memory than a step.
    found, backward = jax.vjp(values, start)
    squares = jax.lax.map(
        lambda row: jnp.sum(backward(row)[0] ** 2), jnp.eye(len(found))
    )
    return jnp.sqrt(squares)


def _looks(settings: AdaptConfig) -> bool:
    """Whether anything of the objective asks what the sensor knows."""
    return settings.visibility_weight > 0 or settings.keep_weight > 0


def _known(inputs: NetworkInput, config: PrismConfig) -> Visibility:
    """The map that the inputs have, or what the cloud says by itself."""
    if inputs.visibility is not None:
        return inputs.visibility
    eye = inputs.view.position
    return seen_by(inputs.partial, eye, config.model.background)


def _tolerance(inputs: NetworkInput) -> Float[Array, ""]:
    return TOLERANCE * spacing_of(inputs.partial)
