"""What `experiments.benchmark` measures, suite by suite."""
