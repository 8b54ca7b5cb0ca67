"""Memory files and point-cloud files."""
