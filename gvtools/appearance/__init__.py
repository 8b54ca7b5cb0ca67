"""Appearance: a compact set of Gaussians fitted to the photographs of a scene."""
