"""Optimisation: jitted steps, optimiser partitions, checkpoints, metrics."""
