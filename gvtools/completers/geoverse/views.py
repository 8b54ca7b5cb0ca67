"""Pictures and projections of any size to the model's grid, and its results back.

Context pictures are cropped about their centre to the targets' aspect and resampled; the cameras
follow. A projection's colour is the mean of the valid pixels under a cell; its depth is that of
one pixel, the cell's centre or, where that is a hole, the farthest, so that no depth between two
surfaces arises. Lengths are in a unit of the views' own, whatever the scene's is.
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
from gvtools.completers.push_pull import Filled
from gvtools.guidance import Guidance
from gvtools.view_selection import covisible_views, nearest_views

# Neighbours whose depths differ by more than this factor lie on two surfaces.
EDGE = 1.1
# A cell of the model's grid counts as valid from this share of valid pixels on.
VALID_SHARE = 0.5
# Views nearer to each other than this share of their distance from the origin stand at one place.
COINCIDENT = 1e-12


def model_size(height: int, width: int, *, longest: int, patch: int) -> tuple[int, int]:
    """(H, W) of a network's pictures: the aspect kept as well as multiples of the patch allow."""
    factor = longest / max(height, width)
    rows, columns = (max(1, round(side * factor / patch)) * patch for side in (height, width))
    return rows, columns


def resample(x: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, C, h, w) to (B, C, H, W): bilinear, with an antialias filter where it shrinks."""
    if tuple(x.shape[-2:]) == size:
        return x
    return F.interpolate(x, size=size, mode="bilinear", align_corners=False, antialias=True)


def resample_depth(depth: Tensor, size: tuple[int, int]) -> Tensor:
    """(T, h, w) depth > 0 to (T, H, W), with none that lies between two surfaces.

    Within a surface the inverse of the depth is interpolated, which keeps a plane a plane; at an
    edge, and where the picture shrinks, a pixel takes the depth of the one that it lies in.
    """
    before = depth.shape[-2], depth.shape[-1]
    if before == size:
        return depth
    nearest = F.interpolate(depth[:, None], size=size, mode="nearest-exact")
    if size[0] < before[0] or size[1] < before[1]:
        return nearest[:, 0]
    farthest = F.max_pool2d(depth[:, None], 3, stride=1, padding=1)
    closest = -F.max_pool2d(-depth[:, None], 3, stride=1, padding=1)
    edge = F.interpolate((farthest > EDGE * closest).float(), size=size, mode="nearest-exact")
    smooth = 1 / resample(1 / depth[:, None], size)
    return torch.where(edge > 0, nearest, smooth)[:, 0]


def choose_views(
    context: Sequence[ContextView],  # to choose from
    targets: Cameras,  # V cameras of one picture size
    # (V, H, W) z-depth of the targets, scene units, filled where that is possible.
    depth: NDArray[np.float32],
    *,
    count: int,  # how many at most
    selection: str,  # "covisible" or "nearest", see ``gvtools.view_selection``
) -> list[ContextView]:
    """At most ``count`` context views, the best first."""
    if not context:
        return []
    cameras = concatenate([view.camera for view in context])
    if selection == "covisible":
        depths = [view.depth for view in context]
        rows = covisible_views(cameras, targets, depth, count=count, depths=depths)
    else:
        rows = nearest_views(cameras, targets, count)
    return [context[row] for row in rows]


def view_batch(
    context: Sequence[ContextView],  # at least one view
    targets: Guidance,  # the projections to complete
    size: tuple[int, int],  # (H, W) of the model's pictures
    *,
    fill: Filled | None = None,  # the targets with their holes filled; None leaves holes at 0
) -> tuple[ViewBatch, Cameras]:
    """One sample of the model, and all cameras (V) at ``size`` in the scene's own frame and unit.

    The sample is in the first context view's frame and a unit in which the farthest view stands at
    a distance of 1.
    """
    height, width = int(targets.cameras.height[0]), int(targets.cameras.width[0])
    pictures, depths, cameras = [], [], []
    for view in context:
        picture, observed, camera = _crop(view, height / width)
        image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float()
        pictures.append(resample(image, size)[0].clamp(0, 1))
        depths.append(resample_nearest(observed, size))
        cameras.append(camera.resized(size[1], size[0]))
    rgb, projected, valid = _reduce(targets, size)
    if fill is not None:
        rgb, projected = _over(rgb, projected, valid, fill=fill)
    cameras.append(targets.cameras.resized(size[1], size[0]))
    joined = concatenate(cameras)
    seen = torch.ones((len(context), 1, *size), dtype=torch.bool)
    depth = torch.cat((torch.stack(depths), projected))
    evidence = None if fill is None else _evidence(fill, len(context), size)
    relative, unit = _relative(joined, depth)
    batch = ViewBatch(
        images=torch.cat((torch.stack(pictures), rgb))[None],
        depth=(depth / unit)[None],
        valid=torch.cat((seen, valid))[None],
        cam_from_world=torch.from_numpy(relative).float()[None],
        K=torch.from_numpy(joined.K).float()[None],
        context=len(context),
        evidence=evidence,
    )
    return batch, joined


def _relative(cameras: Cameras, depth: Tensor) -> tuple[NDArray[np.float64], float]:
    """(V, 4, 4) ``cam_from_world`` in the first view's frame, and its unit in scene units.

    The unit is the distance of the farthest view, or the median depth for views that all stand at
    one place, so that networks see the same numbers in a scene of millimetres and of kilometres.
    """
    relative = cameras.cam_from_world @ cameras.world_from_cam[:1]
    unit = float(np.linalg.norm(relative[:, :3, 3], axis=1).max())
    if unit <= COINCIDENT * np.abs(cameras.cam_from_world[:, :3, 3]).max():
        relative[:, :3, 3] = 0
        known = depth[torch.isfinite(depth) & (depth > 0)]
        return relative, float(known.median()) if known.numel() else 1.0
    relative[:, :3, 3] /= unit
    return relative, unit


def context_depth(
    context: Sequence[ContextView], targets: Guidance, size: tuple[int, int]
) -> NDArray[np.float32]:
    """(C, H, W) known depth of the context as ``view_batch`` crops it, scene units; 0 = none."""
    aspect = int(targets.cameras.height[0]) / int(targets.cameras.width[0])
    depths = [resample_nearest(_crop(view, aspect)[1], size)[0].numpy() for view in context]
    return np.stack(depths).astype(np.float32)


def crop_to_aspect(camera: Cameras, aspect: float) -> tuple[tuple[slice, slice], Cameras]:
    """The middle of a picture, height / width near ``aspect``: rows and columns, and its camera."""
    height, width = int(camera.height[0]), int(camera.width[0])
    rows = min(height, max(1, round(width * aspect)))
    columns = min(width, max(1, round(height / aspect)))
    top, left = (height - rows) // 2, (width - columns) // 2
    window = np.s_[top : top + rows, left : left + columns]
    return window, camera.cropped(left, top, width=columns, height=rows)


def _crop(
    view: ContextView, aspect: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], Cameras]:
    window, camera = crop_to_aspect(view.camera, aspect)
    depth = np.zeros(view.rgb.shape[:2], np.float32) if view.depth is None else view.depth
    return view.rgb[window], depth[window], camera


def _over(rgb: Tensor, depth: Tensor, valid: Tensor, *, fill: Filled) -> tuple[Tensor, Tensor]:
    """Projections (T, 3, h, w) and (T, 1, h, w) over a fill of any size, where that has depth."""
    size = (rgb.shape[-2], rgb.shape[-1])
    color = resample(torch.from_numpy(fill.rgb).permute(0, 3, 1, 2).float(), size).clamp(0, 1)
    lengths = torch.from_numpy(fill.depth).float()[:, None]
    lengths = F.interpolate(lengths, size=size, mode="nearest-exact")
    color = torch.where(lengths > 0, color, 0.0)
    return torch.where(valid, rgb, color), torch.where(valid, depth, lengths)


def _evidence(fill: Filled, context: int, size: tuple[int, int]) -> Tensor:
    """(1, V, 2, h, w) confidence of the fill and weight of the photographs; 0 on the context."""
    nothing = np.zeros_like(fill.depth)
    maps = [nothing if known is None else known for known in (fill.confidence, fill.looked_up)]
    evidence = resample(torch.from_numpy(np.stack(maps, 1)), size).clamp(0, 1)
    return torch.cat((evidence.new_zeros((context, 2, *size)), evidence))[None]


def resample_nearest(depth: NDArray[np.float32], size: tuple[int, int]) -> Tensor:
    """(H, W) to (1, h, w), the pixel under each cell's centre."""
    image = torch.from_numpy(np.ascontiguousarray(depth)).float()[None, None]
    return F.interpolate(image, size=size, mode="nearest-exact")[0]


def _reduce(targets: Guidance, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, 3, h, w), depth (T, 1, h, w) and validity (T, 1, h, w) of projections."""
    # Chosen, not multiplied: a NaN in a hole stays there.
    rgb, depth = (
        torch.from_numpy(np.where(known, values, np.float32(0)))
        for known, values in (
            (targets.valid[..., None], targets.rgb),
            (targets.valid, targets.depth),
        )
    )
    rgb, depth = rgb.permute(0, 3, 1, 2), depth[:, None]
    share = resample(torch.from_numpy(targets.valid).float()[:, None], size)
    colour = resample(rgb, size) / share.clamp_min(1e-6)
    valid = share >= VALID_SHARE
    nearest = F.interpolate(depth, size=size, mode="nearest-exact")
    # Where the centre's own pixel is a hole, the greatest depth under the cell: the far side.
    window = [max(1, -(-full // cell)) for full, cell in zip(depth.shape[-2:], size, strict=True)]
    far = F.adaptive_max_pool2d(depth, size) if max(window) > 1 else nearest
    depth = torch.where(nearest > 0, nearest, far) * valid
    return (colour * valid).clamp(0, 1), depth, valid & (depth > 0)
