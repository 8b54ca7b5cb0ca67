"""Pictures and projections of any size to the model's grid, and its results back.

Context pictures are cropped about their centre to the targets' aspect and resampled; the cameras
follow. A projection's colour is the mean of the valid pixels under a cell; its depth is that of
one pixel, the nearest valid one to the cell's centre, so that no depth between two surfaces arises.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gvtools.cameras import Cameras, concatenate
from gvtools.completers.base import ContextView
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.guidance import Guidance

# A cell of the model's grid counts as valid from this share of valid pixels on.
VALID_SHARE = 0.5


def model_size(height: int, width: int, *, longest: int, patch: int) -> tuple[int, int]:
    """(H, W) of the model's pictures: the aspect kept as well as multiples of the patch allow."""
    factor = longest / max(height, width)
    return tuple(max(1, round(side * factor / patch)) * patch for side in (height, width))  # type: ignore[return-value]


def view_batch(
    context: Sequence[ContextView], targets: Guidance, size: tuple[int, int]
) -> tuple[ViewBatch, Cameras]:
    """One sample of the model.

    Args:
        context: at least one view.
        targets: the projections to complete.
        size: (H, W) of the model's pictures.

    Returns:
        The batch, its world being the first context view's frame, and all cameras (V) at ``size``
        in the scene's own frame.
    """
    height, width = int(targets.cameras.height[0]), int(targets.cameras.width[0])
    pictures, depths, cameras = [], [], []
    for view in context:
        picture, depth, camera = _cropped(view, height / width)
        pictures.append(_resampled(picture, size))
        depths.append(_nearest(depth, size))
        cameras.append(camera.resized(size[1], size[0]))
    rgb, depth, valid = _reduced(targets, size)
    cameras.append(targets.cameras.resized(size[1], size[0]))
    joined = concatenate(cameras)
    seen = torch.ones((len(context), 1, *size), dtype=torch.bool)
    relative = joined.cam_from_world @ joined.world_from_cam[:1]
    batch = ViewBatch(
        images=torch.cat((torch.stack(pictures), rgb))[None],
        depth=torch.cat((torch.stack(depths), depth))[None],
        valid=torch.cat((seen, valid))[None],
        cam_from_world=torch.from_numpy(relative).float()[None],
        K=torch.from_numpy(joined.K).float()[None],
        context=len(context),
    )
    return batch, joined


def enlarged(x: Tensor, size: tuple[int, int]) -> Tensor:
    """(T, C, h, w) to (T, C, H, W): bilinear, with an antialias filter where it shrinks."""
    if tuple(x.shape[-2:]) == size:
        return x
    return F.interpolate(x, size=size, mode="bilinear", align_corners=False, antialias=True)


def _cropped(
    view: ContextView, aspect: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], Cameras]:
    """The middle of a view, height / width near ``aspect``."""
    height, width = view.rgb.shape[:2]
    rows = min(height, max(1, round(width * aspect)))
    columns = min(width, max(1, round(height / aspect)))
    top, left = (height - rows) // 2, (width - columns) // 2
    window = np.s_[top : top + rows, left : left + columns]
    depth = np.zeros((height, width), np.float32) if view.depth is None else view.depth
    camera = view.camera.cropped(left, top, columns, rows)
    return view.rgb[window], depth[window], camera


def _resampled(picture: NDArray[np.float32], size: tuple[int, int]) -> Tensor:
    """(H, W, 3) to (3, h, w)."""
    image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float()
    return enlarged(image, size)[0].clamp(0, 1)


def _nearest(depth: NDArray[np.float32], size: tuple[int, int]) -> Tensor:
    """(H, W) to (1, h, w), the pixel under each cell's centre."""
    image = torch.from_numpy(np.ascontiguousarray(depth)).float()[None, None]
    return F.interpolate(image, size=size, mode="nearest-exact")[0]


def _reduced(targets: Guidance, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, 3, h, w), depth (T, 1, h, w) and validity (T, 1, h, w) of projections."""
    weight = torch.from_numpy(targets.valid).float()[:, None]
    rgb = torch.from_numpy(np.ascontiguousarray(targets.rgb)).float().permute(0, 3, 1, 2) * weight
    share = enlarged(weight, size)
    colour = enlarged(rgb, size) / share.clamp_min(1e-6)
    valid = share >= VALID_SHARE
    depth = torch.from_numpy(np.ascontiguousarray(targets.depth)).float()[:, None] * weight
    nearest = F.interpolate(depth, size=size, mode="nearest-exact")
    # Where the centre's own pixel is a hole, the greatest depth under the cell: the far side.
    window = [max(1, -(-full // cell)) for full, cell in zip(depth.shape[-2:], size, strict=True)]
    far = F.adaptive_max_pool2d(depth, size) if max(window) > 1 else nearest
    depth = torch.where(nearest > 0, nearest, far) * valid
    return (colour * valid).clamp(0, 1), depth, valid & (depth > 0)
