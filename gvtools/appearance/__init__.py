"""What a scene looks like: a compact set of Gaussians fitted to its photographs."""
