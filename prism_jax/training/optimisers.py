"""The optimiser of every network that is trained, with its schedule."""

import functools
from typing import Literal

import jax.numpy as jnp
import optax
import optax.contrib

Kind = Literal["sgd", "adam", "muon"]

MUON_RMS = 0.2  # of an update's entries, over the step size: as large as Adam's


def optimiser(
    kind: Kind,
    learning_rate: float,
    num_steps: int,
    final_rate: float,
    warmup_steps: int,
    clip_norm: float,
) -> optax.GradientTransformation:
    """Adam, Muon (of matrices; of all else Adam with Nesterov's momentum), or plain
    gradient descent, under a gradient clipped to ``clip_norm``, if any.

    The step size rises linearly from zero for ``warmup_steps``, or for half of the
    steps, and then falls along a cosine to ``final_rate`` times ``learning_rate``.
    Muon: Jordan 2024; its scale: Liu et al. 2025, "Muon is Scalable for LLM Training".
    """
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=0.0 if warmup_steps else learning_rate,
        peak_value=learning_rate,
        warmup_steps=min(warmup_steps, num_steps // 2),
        decay_steps=num_steps,
        end_value=final_rate * learning_rate,
    )
    muon = functools.partial(optax.contrib.muon, consistent_rms=MUON_RMS)
    make = {"sgd": optax.sgd, "adam": optax.adam, "muon": muon}[kind]
    return optax.chain(optax.clip_by_global_norm(clip_norm or jnp.inf), make(schedule))
