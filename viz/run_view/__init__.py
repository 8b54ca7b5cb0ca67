"""A run prepared for viewers: its points by round, their colours and detail."""
