"""Depth Anything 3: the frozen geometry network, its rays, and its published weights."""
