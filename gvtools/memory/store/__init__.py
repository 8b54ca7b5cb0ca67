"""What the memory consists of: columns of observations, source views, the voxel index."""
