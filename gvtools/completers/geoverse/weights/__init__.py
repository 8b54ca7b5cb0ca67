"""Weights on disk: published files, strict loading, saving, and what does not fit."""
