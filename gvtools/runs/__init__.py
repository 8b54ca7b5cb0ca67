"""The folder of a run: its layout, identity, lock and resume, and a run read back from it."""
