"""Layouts that gvtools reads, and benchmarks that it stands beside, as YAML."""
