"""A window on a run, and pictures of it without a display."""
