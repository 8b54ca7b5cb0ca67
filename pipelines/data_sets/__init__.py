"""What ``gvtools data`` does with data sets."""
