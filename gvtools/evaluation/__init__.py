"""Measures of what a run produced, against references."""
