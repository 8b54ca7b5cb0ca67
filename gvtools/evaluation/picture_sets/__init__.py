"""Pictures that any method made, read from the folders that its tools write."""
