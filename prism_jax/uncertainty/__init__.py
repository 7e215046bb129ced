"""How far a completion, and each of its points, can be trusted."""
