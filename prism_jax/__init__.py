"""PRISM in JAX: completion of sparse scans with test-time adaptation."""
