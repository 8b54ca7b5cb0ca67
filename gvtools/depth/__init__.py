"""Sources of depth: sensors, COLMAP, plane sweep, networks and fitted Gaussians."""
