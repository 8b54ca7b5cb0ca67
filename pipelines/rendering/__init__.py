"""Pictures of a saved memory in given cameras, and their figures."""
