"""Command line and the steps that it composes."""
