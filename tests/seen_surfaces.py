"""Which target pixels show a surface that some context view shows, from the true depth."""

from __future__ import annotations

import torch
from torch import Tensor

from gvtools.training.view_sample import Sample

# Depths that differ by no more than this share belong to one surface.
SAME_SURFACE = 0.03


def seen_by_context(sample: Sample, *, tolerance: float = SAME_SURFACE) -> Tensor:
    """(V, 1, H, W) bool: some context view shows the surface; True on context views.

    The depth that a point has in a context view is compared with the view's own depth, the nearer
    of the four pixels round it and the farther one being the ends of what agrees.

    Args:
        sample: with true depth on all views.
        tolerance: relative.
    """
    views, _, height, width = sample.depth.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixel = torch.stack((x, y, torch.ones_like(x))).flatten(1).double()
    pose, K = sample.cam_from_world.double(), sample.K.double()
    world_from_cam = torch.linalg.inv(pose)
    local = torch.linalg.inv(K) @ pixel * sample.depth.double().flatten(2)
    points = world_from_cam[:, :3, :3] @ local + world_from_cam[:, :3, 3:]
    seen = torch.zeros((views, height * width), dtype=torch.bool)
    seen[: sample.context] = True
    for view in range(sample.context):
        there = K[view] @ (pose[view, :3, :3] @ points + pose[view, :3, 3:])
        z = there[:, 2]
        column, row = (there[:, i] / z.clamp_min(1e-9) - 0.5 for i in (0, 1))
        inside = (z > 0) & (column > -0.5) & (column < width - 0.5)
        inside &= (row > -0.5) & (row < height - 0.5)
        own = sample.depth[view, 0].double()
        left, top = column.floor().nan_to_num().long(), row.floor().nan_to_num().long()
        around = torch.stack(
            [
                own[(top + i).clamp(0, height - 1), (left + j).clamp(0, width - 1)]
                for i in (0, 1)
                for j in (0, 1)
            ]
        )
        near, far = around.amin(0) * (1 - tolerance), around.amax(0) * (1 + tolerance)
        seen |= inside & (z >= near) & (z <= far)
    seen &= (sample.depth > 0).flatten(1)
    return seen.unflatten(1, (height, width))[:, None]
