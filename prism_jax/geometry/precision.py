"""Products of float32 that keep every bit, on every platform."""

import jax

exact_products = jax.default_matmul_precision("highest")
"""Decorates functions whose matrix products must not be rounded. GPUs round the factors
to TF32 unless told otherwise: each is off by up to a two-thousandth of itself."""
