"""Scores of pictures and runs: evaluation, judgement, benchmarks and trade-offs."""
