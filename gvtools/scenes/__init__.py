"""What a run reads: COLMAP projects, posed RGB-D folders, transforms.json, and samples."""
