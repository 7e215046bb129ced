"""`prism-stream` from the repository: python -m experiments.stream RECORDING."""

from prism_jax.cli.stream import run

if __name__ == "__main__":
    run()
