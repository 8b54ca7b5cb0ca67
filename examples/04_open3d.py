"""The memory is an Open3D point cloud: crop it, compute normals, find planes, write it.

python examples/04_open3d.py [PROJECT [OUT]]
"""

from __future__ import annotations

import numpy as np
import open3d as o3d
from sample import output_folder, sample_project

import gvtools

memory = gvtools.SpatialMemory(voxel=0.02)
for view in gvtools.open_project(sample_project()):
    frame = view.load()
    if frame.depth is not None:
        memory.observe(frame.rgb, frame.depth, view.camera, round=0, mask=frame.mask)

cloud = memory.cloud  # open3d.t.geometry.PointCloud; no copy
print(cloud)

trusted = cloud.select_by_mask(cloud.point.confidence.flatten() > 0.5)
print(f"{len(trusted.point.positions):,} of {len(memory):,} observations have confidence > 0.5")

lower, upper = np.quantile(cloud.point.positions.numpy(), [0.25, 0.75], axis=0)
inner = cloud.crop(o3d.t.geometry.AxisAlignedBoundingBox(lower, upper))
print(f"{len(inner.point.positions):,} observations in the middle half of the scene")

small = cloud.voxel_down_sample(0.05)
small.estimate_normals(max_nn=20)
plane, inliers = small.segment_plane(distance_threshold=0.02, ransac_n=3, num_iterations=500)
print(f"largest plane {plane.numpy().round(2)}: {len(inliers) / len(small.point.positions):.0%}")

path = output_folder() / "cloud.ply"
o3d.t.io.write_point_cloud(str(path), small)
print(f"written: {path}")
