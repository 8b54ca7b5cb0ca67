"""Tuning of the generative core to one scene."""
