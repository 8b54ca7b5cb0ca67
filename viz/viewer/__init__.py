"""The viewer of runs: one model of a run, and its web page, window and pictures."""
