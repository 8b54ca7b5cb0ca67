"""What the HTML report of a run shows, collected from its folder."""
