"""Projects as they are read: COLMAP, posed RGB-D, transforms.json, phones, data sets, samples."""
