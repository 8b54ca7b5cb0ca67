"""A project split into blocks that are reconstructed each by itself, and their runs merged."""
