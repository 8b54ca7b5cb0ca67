"""What commands accept as input: trajectories, runs and memories."""
