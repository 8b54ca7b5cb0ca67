"""The paper's experiments on held-out scenes; each is one ``gvtools experiment NAME``."""
