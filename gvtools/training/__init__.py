"""What the generative core is trained on: procedural scenes, recorded scenes, hints, batches."""
