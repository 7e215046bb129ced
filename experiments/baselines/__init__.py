"""Completion by other means, to compare with: published networks and trivial ones."""
