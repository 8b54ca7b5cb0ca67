"""How speed trades for accuracy on a user's own scene: what is varied, tried, and recommended."""
