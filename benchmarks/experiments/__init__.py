"""The experiments on held-out scenes: ``python -m benchmarks.experiments NAME``."""
