"""`prism-envelope` from the repository: python -m experiments.envelope SCAN."""

from prism_jax.cli.envelope import run

if __name__ == "__main__":
    run()
