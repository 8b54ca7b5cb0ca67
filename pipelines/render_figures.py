"""What a rendered view is worth: its time, its coverage, and its figures against a picture."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError
from gvtools.evaluation.images import SSIM_BORDER, psnr, relative_depth_error, ssim
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat import SplatOptions
from gvtools.scenes.scene import Frame

METRICS = (
    "psnr",
    "ssim",
    "lpips",
    "psnr_valid",
    "ssim_valid",
    "psnr_generated",
    "depth_rel_valid",
    "depth_rel_generated",
)
NO_LPIPS = "no LPIPS: the weights of its network are not part of this installation"


def render_view(
    memory: SpatialMemory, camera: Cameras, options: SplatOptions
) -> tuple[Guidance, float]:
    """One projection and its seconds."""
    start = time.perf_counter()
    guidance = memory.project(camera, options=options)
    return guidance, time.perf_counter() - start


def measure(
    name: str, guidance: Guidance, frame: Frame | None, *, seconds: float
) -> dict[str, Any]:
    """The figures of one view; those that need a picture are None without one.

    A picture's mask limits every comparison and leaves the coverage as it is. On all pixels, holes
    count as black.

    Args:
        name: the view's.
        guidance: a batch of one.
        frame: the picture, and depth where there is some, of the same camera.
        seconds: what the projection took.

    Raises:
        ShapeError: the picture is of another size.
    """
    figures: dict[str, Any] = {"view": name, "coverage": guidance.coverage, "seconds": seconds}
    figures |= dict.fromkeys(METRICS)
    if frame is None:
        return figures
    rgb, depth, valid = guidance.rgb[0], guidance.depth[0], guidance.valid[0]
    if frame.rgb.shape != rgb.shape:
        raise ShapeError(f"{name}: the picture is {frame.rgb.shape}; its camera needs {rgb.shape}")
    use = np.ones(valid.shape, np.bool_) if frame.mask is None else frame.mask
    generated = guidance.generated[0] & valid & use
    whole = None if frame.mask is None else use
    figures["psnr"] = psnr(rgb, frame.rgb, mask=whole)
    figures["psnr_valid"] = psnr(rgb, frame.rgb, mask=valid & use)
    figures["psnr_generated"] = psnr(rgb, frame.rgb, mask=generated)
    if min(valid.shape) > 2 * SSIM_BORDER:
        figures["ssim"] = ssim(rgb, frame.rgb, mask=whole)
        figures["ssim_valid"] = ssim(rgb, frame.rgb, mask=valid & use)
    if frame.depth is not None:
        figures["depth_rel_valid"] = relative_depth_error(depth, frame.depth, mask=valid & use)
        figures["depth_rel_generated"] = relative_depth_error(depth, frame.depth, mask=generated)
    return figures


def summary(views: Sequence[dict[str, Any]], *, compared: bool) -> dict[str, Any]:
    """Means over the views that have a figure (time: median), with reasons for what is missing."""
    out: dict[str, Any] = {}
    notes: dict[str, str] = {}
    for key in METRICS:
        values = [view[key] for view in views if view[key] is not None]
        out[key] = statistics.fmean(values) if values else None
        if key == "lpips":
            notes[key] = NO_LPIPS
        elif not compared:
            notes[key] = "not compared: add --against-images"
        elif not values:
            notes[key] = _reason(key)
        elif len(values) < len(views):
            notes[key] = f"mean of {len(values)} of {len(views)} views; the others have no figure"
        if out[key] == float("inf"):
            notes[key] = "infinite: the pictures are equal"
    out["coverage"] = statistics.fmean(view["coverage"] for view in views)
    out["views"] = len(views)
    out["seconds_per_view"] = statistics.median(view["seconds"] for view in views)
    out["per_view"] = list(views)
    out["notes"] = notes
    return out


def _reason(key: str) -> str:
    if key.endswith("generated"):
        return "no generated content in view, or no reference there"
    if key.startswith("depth"):
        return "no reference depth where the memory is in view"
    return "no pixel to compare"
