"""Training of the generative core: stages, sources of examples, checkpoints."""
