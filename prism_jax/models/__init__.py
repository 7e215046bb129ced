"""Flax Linen modules: parameters and wiring."""
