"""Objects that people modelled, from packages that the user has installed."""
