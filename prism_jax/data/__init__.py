"""Procedural shapes, simulated partial views, and the corpus made of them."""
