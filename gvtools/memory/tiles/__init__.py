"""A memory larger than RAM: tiles of voxels in files, some of them in RAM."""
