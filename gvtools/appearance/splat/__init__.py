"""Splatting of Gaussians, with gradients."""
