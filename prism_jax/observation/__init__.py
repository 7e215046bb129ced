"""From points and a sensor to what the network reads, and back to the user's frame."""

from prism_jax.observation.observation import UNKNOWN_EYE, Observation, observe
from prism_jax.observation.upright import UP_AXES, upright

__all__ = ["UNKNOWN_EYE", "UP_AXES", "Observation", "observe", "upright"]
