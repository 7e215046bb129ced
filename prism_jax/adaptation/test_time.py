"""Test-time adaptation of the encoders to one frame, Eq. 13."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.inner_loop import step_sizes, unroll
from prism_jax.adaptation.objective import Losses, test_time_objective
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Visibility
from prism_jax.models.poses import in_other_poses, to_original_frame
from prism_jax.models.prism import hold_decoding, prepare_input
from prism_jax.models.variables import Variables, pop_encoders, put_encoders


class Completion(NamedTuple):
    """A completed frame, in the unit workspace.

    Attributes:
      points: the completion, adapted if that was accepted; behind it those of the frame
        in other poses, if there are some (``config.model.poses``), by the same
        encoders. No loss looks at those.
      before: the completion of the network as it was.
      accepted: whether the adapted completion is the one returned: the objective of
        Eq. 13 did not rise, and everything stayed finite.
      losses: every term before each step, and after the last: K + 1 values. None
        without steps: they would double what is compiled.
      weights: of the auxiliary losses, softmax(eta*).
      encoders: the encoders' parameters that made ``points``, with the samples
        and neighbours of the decoding before (`prism_jax.models.prism.hold_decoding`).
      features: the point stream's global feature, of the network as it was.
    """

    points: Float[Array, "N 3"]
    before: Float[Array, "N 3"]
    accepted: Bool[Array, ""]
    losses: Losses | None
    weights: Float[Array, "3"]
    encoders: Variables
    features: Float[Array, " G"]


AdaptFn = Callable[..., Completion]
"""Of variables, partial, camera and, if it is known, visibility."""


def make_adapt(config: PrismConfig = PrismConfig()) -> AdaptFn:
    """The adaptation function of a configuration.

    It takes variables (`prism_jax.load_pretrained`), a partial cloud of exactly
    ``config.model.backbone.num_points`` points (`geometry.sampling.resample`), a
    camera, and optionally visibility, all in the unit workspace
    (`prism_jax.Workspace`). It is pure: ``jit`` it, ``vmap`` it over partials and
    cameras (each frame then has its own encoders). Only the two encoders are updated.
    The completion is differentiable in the variables, through the steps; no gradient
    reaches the cloud or the camera. If a value was not finite, neither is the gradient.

    If a loss or a coordinate is not finite, or the last objective is above the first,
    adaptation is rejected: ``accepted`` is False, and the completion is that of the
    network without adaptation. With ``num_steps=0`` nothing is adapted.
    """
    settings = config.adapt

    def adapt(
        variables: Variables,
        partial: Float[Array, "N 3"],
        camera: Camera,
        visibility: Visibility | None = None,
    ) -> Completion:
        model, wanted = config.model, config.model.backbone.num_points
        if partial.ndim != 2 or partial.shape[0] != wanted:
            raise ValueError(
                f"adapt takes one cloud of {wanted} points, not an array of shape "
                f"{partial.shape}; use prism_jax.geometry.sampling.resample, and "
                "jax.vmap for frames"
            )
        key = jax.random.key(settings.seed)
        inputs = prepare_input(partial, camera, key, model, visibility=visibility)
        others = None
        if model.poses > 1:
            others = in_other_poses(partial, camera, key, model, visibility)
        encoders, rest = pop_encoders(variables)
        weights = jax.nn.softmax(variables["weighting"]["logits"])
        if settings.num_steps == 0:
            every = jax.tree.map(lambda leaf: leaf[None], inputs)
            if others is not None:
                every = jax.tree.map(lambda *each: jnp.concatenate(each), every, others)
            points, features = to_original_frame(variables, every, model, first=0)
            nothing = jnp.zeros((), bool), None
            return Completion(points, points, *nothing, weights, encoders, features)
        inputs = hold_decoding(variables, inputs, model)
        if others is not None:
            others = jax.vmap(lambda one: hold_decoding(variables, one, model))(others)

        def with_others(points: Array, moving: Variables) -> Array:
            """The points, and those of the frame in other poses."""
            if others is None:
                return points
            beside, _ = to_original_frame(put_encoders(moving, rest), others, model)
            return jnp.concatenate([points, beside])

        # Compiled, so that it is traced once for the steps and for what follows them.
        @jax.jit
        def loss_fn(moving: Variables):
            whole = put_encoders(moving, rest)
            losses, prediction = test_time_objective(whole, inputs, config)
            features = prediction.encoded.global_feature
            return losses.objective, (losses, prediction.points, features)

        adapted, (_, (before, points, features)) = unroll(
            loss_fn,
            encoders,
            step_sizes(variables, settings),
            settings.num_steps,
            clip_norm=settings.clip_norm,
        )
        _, (after, last, _) = loss_fn(adapted)
        last = with_others(last, adapted)
        losses = jax.tree.map(
            lambda steps, final: jnp.concatenate([steps, final[None]]), before, after
        )
        first = with_others(points[0], encoders)
        finite = jnp.isfinite(jnp.stack(jax.tree.leaves(losses))).all()
        improved = finite & (losses.objective[-1] <= losses.objective[0])
        accepted = improved & jnp.isfinite(last).all()
        return Completion(
            jnp.where(accepted, last, first),
            first,
            accepted,
            losses,
            weights,
            jax.tree.map(lambda a, e: jnp.where(accepted, a, e), adapted, encoders),
            features[0],
        )

    return adapt
