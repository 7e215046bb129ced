"""`prism-complete` from the repository: python -m experiments.complete --input=FILE."""

from prism_jax.cli.complete import run

if __name__ == "__main__":
    run()
