"""Whole benchmarks: every scene, number of views and method, resumable, and the tables of it."""
