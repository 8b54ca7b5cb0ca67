"""Store of the memory: columns of observations, source views, the voxel index."""
