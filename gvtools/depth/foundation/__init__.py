"""Depth Anything 3 as a depth source; see ``source.py``."""
