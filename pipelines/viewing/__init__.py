"""The viewers' sources: runs and exported files; the page that follows a run."""
