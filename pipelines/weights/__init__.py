"""Published network weights: what a model needs, and whether a folder fits."""
