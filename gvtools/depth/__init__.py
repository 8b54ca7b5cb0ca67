"""Where the depth of a view comes from."""
