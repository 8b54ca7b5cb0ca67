"""One page to share: a run's Gaussians in one HTML file that asks the network for nothing."""
