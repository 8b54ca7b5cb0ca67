"""The viewers of runs: what they read, the web page that follows a run, pictures."""
