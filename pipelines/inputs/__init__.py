"""Inputs of commands: trajectories, runs and memories."""
