"""A memory's state: columns of observations, views, voxel index, and tiles in RAM or in files."""
