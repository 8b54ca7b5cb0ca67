"""A pass's result at the targets' own size, in the memory's scale and exposure.

Decoded pictures are resampled, and their depth scaled to what is known; or, where the model's form
is a correction, what it changed is added to the filled projection at full resolution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.cameras import Cameras
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.correction import composed, corrected_color, corrected_depth
from gvtools.completers.geoverse.depth_scale import MAX_FACTOR, both_known, pass_scale, scaled_depth
from gvtools.completers.geoverse.passes import Generated
from gvtools.completers.geoverse.refiner import Refiner, completed_views
from gvtools.completers.geoverse.resampling import resampled, resampled_depth
from gvtools.completers.push_pull import Filled, push_pull, push_pull_depth
from gvtools.completers.scale_alignment import ScaleAlignment, ScaleStatus
from gvtools.guidance import Guidance

# Confidence of a generated pixel at most: below what was observed.
GENERATED = 0.9
# Confidence of a corrected view whose decoded depth is far from the memory's.
UNSCALED = 0.1
# What remains of a fill's confidence where the model moves its depth, and in such a view.
DOUBTED = 0.5
# Confidence of a refined pixel whose depth is right for certain.
REFINED = 0.5
# A view's scale is taken from at least so many pixels, and from about so many at most.
LEAST, LOOKED_AT = 50, 5_000


@dataclass(frozen=True)
class Completed:
    """A pass's result at the targets' size and in scene units.

    Attributes:
        rgb: (T, H, W, 3) in [0, 1].
        depth: (T, H, W) z-depth; 0 = none.
        confidence: (T, H, W) in [0, 1]; 0 where there is no depth.
        rays: (T, H, W, 6) predicted Plücker rays, world frame; None without a scale, and where
            they were not asked for.
        scales: (T,) scene units per unit of the model; NaN where refused.
        alignment: for each view, what its scale rests on.
    """

    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    rays: NDArray[np.float32] | None
    scales: NDArray[np.float64]
    alignment: tuple[ScaleAlignment, ...]


def to_scene_scale(
    generated: Generated,
    guidance: Guidance,
    cameras: Cameras,
    *,
    known: NDArray[np.float32],
    alignment: str,
    color_alignment: str,
) -> Completed:
    """Pictures, depth, confidence and rays of the targets at their own size, in scene units.

    Args:
        generated: of the pass.
        guidance: its targets' projections.
        cameras: of all views, at the model's size.
        known: (C, h, w) depth of the context at the model's size.
        alignment: see ``depth_scale``.
        color_alignment: "field" for ``aligned_color``, or "unchanged".
    """
    geometry, context = generated.decoded.geometry, len(known)
    full = (guidance.depth.shape[1], guidance.depth.shape[2])
    rgb = resampled(generated.decoded.rgb[0].float().cpu(), full).clamp(0, 1)
    if color_alignment == "field":
        hint = torch.from_numpy(guidance.rgb).permute(0, 3, 1, 2)
        rgb = aligned_color(rgb, hint, torch.from_numpy(guidance.valid)[:, None])
    depth = resampled_depth(generated.decoded.depth[0].float().cpu(), full)
    world_from_cam = cameras.world_from_cam
    whole = pass_scale(geometry, world_from_cam, known)
    # A pixel without a colour has no depth either: nothing of it enters the memory.
    depth = torch.where(rgb.isfinite().all(1), depth, torch.nan)
    scaled = scaled_depth(depth, guidance.depth, guidance.valid, whole=whole, alignment=alignment)
    confidence = _certainty(generated.decoded.depth_confidence[0], full)
    confidence[~((scaled.depth > 0) & np.isfinite(confidence))] = 0
    found = scaled.scale[np.isfinite(scaled.scale)]
    rays = None
    if len(found):
        rays = _plucker(
            geometry.ray[0, context:], world_from_cam[0], float(np.median(found)), full=full
        )
    picture = rgb.nan_to_num().permute(0, 2, 3, 1).numpy()
    return Completed(picture, scaled.depth, confidence, rays, scaled.scale, scaled.alignment)


def aligned_color(rgb: Tensor, hint: Tensor, valid: Tensor) -> Tensor:
    """Pictures with the push-pull of ``hint - rgb`` over valid pixels added, in [0, 1].

    What a small network decodes is off by a little all over, and a hole's fill then shows its rim.

    Args:
        rgb: (T, 3, H, W) of the model; a pixel that is not finite stays so.
        hint: (T, 3, H, W) the memory's colour.
        valid: (T, 1, H, W) where it is known.
    """
    known = valid & torch.isfinite(rgb).all(1, keepdim=True)
    offset = push_pull(torch.where(known, hint - rgb, 0.0), known)
    return (rgb + offset).clamp(0, 1)


def corrected(
    generated: Generated, guidance: Guidance, fill: Filled, *, back: Completed | None = None
) -> Completed:
    """The filled projection with what the model changed, in views that memory tells of.

    Args:
        generated: with the hints' decoding.
        guidance: the targets' projections.
        fill: the filled projections.
        back: what stands where the fill has no depth; None where it has depth everywhere.
    """
    assert generated.hint is not None
    full = (guidance.depth.shape[1], guidance.depth.shape[2])
    filled = torch.from_numpy(fill.rgb).permute(0, 3, 1, 2), torch.from_numpy(fill.depth)
    both = [
        (
            resampled(found.rgb[0].float().cpu(), full),
            resampled_depth(found.depth[0].float().cpu(), full)[:, None],
        )
        for found in (generated.decoded, generated.hint)
    ]
    valid = torch.from_numpy(guidance.valid)[:, None]
    rgb = corrected_color(filled[0], both[0][0], both[1][0], valid=valid)
    rgb = rgb.clamp(0, 1).permute(0, 2, 3, 1)
    depth = corrected_depth(filled[1][:, None], both[0][1], both[1][1], valid=valid)[:, 0]
    use = (filled[1] > 0) & rgb.isfinite().all(-1) & depth.isfinite()
    known = use.numpy()
    scales = depth_ratios(guidance, both[0][1][:, 0].numpy())
    if back is None:
        nothing = np.zeros(known.shape, np.float32)
        back = Completed(
            np.zeros((*known.shape, 3), np.float32),
            nothing,
            nothing,
            None,
            scales,
            tuple(ScaleAlignment(ScaleStatus.UNSUPPORTED, np.nan) for _ in scales),
        )
    if fill.confidence is None:
        certain = _certainty(generated.decoded.depth_confidence[0], full)
        certain[~np.isfinite(scales)] = UNSCALED
        certain[~np.isfinite(certain)] = 0
    else:
        doubted = (depth.numpy() != fill.depth) | ~np.isfinite(scales)[:, None, None]
        certain = np.where(doubted, DOUBTED * fill.confidence, fill.confidence)
    return replace(
        back,
        rgb=np.where(known[..., None], rgb.numpy(), back.rgb),
        depth=np.where(known, depth.numpy(), back.depth),
        confidence=np.where(known, certain, back.confidence),
        alignment=tuple(
            replace(alignment, status=ScaleStatus.MEMORY_SURFACES, scale=1.0)
            if view.any()
            else alignment
            for view, alignment in zip(known, back.alignment, strict=True)
        ),
    )


@torch.no_grad()
def refined(
    completed: Completed,
    guidance: Guidance,
    refiner: Refiner,
    *,
    batch: ViewBatch,
    generated: Generated,
) -> Completed:
    """Completed views with the refiner's colours, and its confidence, in their holes.

    Args:
        completed: at the targets' size.
        guidance: the targets' projections.
        refiner: on the device of the pass.
        batch: filled as the model saw it (``conditioning.filled``).
        generated: of the pass, with the hints' decoding.
    """
    full = (guidance.depth.shape[1], guidance.depth.shape[2])
    made, _ = composed(batch, generated.decoded, generated.hint)
    finite = made.isfinite()
    found = refiner(completed_views(batch, torch.where(finite, made, 0.0)))
    found = replace(found, **{name: values.cpu() for name, values in vars(found).items()})
    valid = torch.from_numpy(guidance.valid)[:, None]
    rgb = torch.from_numpy(completed.rgb).permute(0, 3, 1, 2)
    rgb = found.colors(rgb, valid).clamp(0, 1)
    right = resampled(found.depth_right, full).sigmoid()[:, 0].numpy()
    certain = np.where(completed.depth > 0, REFINED * right**4, 0)
    # Where the model's depth is far from the memory's, what was said before holds, too.
    unscaled = ~np.isfinite(completed.scales)[:, None, None]
    certain = np.where(unscaled, np.minimum(certain, completed.confidence), certain)
    return replace(
        completed,
        rgb=rgb.permute(0, 2, 3, 1).numpy(),
        confidence=np.where(guidance.valid, completed.confidence, certain).astype(np.float32),
    )


def depth_ratios(guidance: Guidance, generated: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T,) scene units per unit of the model; NaN where its depth is not the memory's by a factor.

    Args:
        guidance: the targets' projections.
        generated: (T, H, W) depth in the model's unit.
    """
    found = np.full(len(guidance), np.nan)
    for index, (view, known, valid) in enumerate(
        zip(generated, guidance.depth, guidance.valid, strict=True)
    ):
        both = both_known(view, known, valid)
        ratio = np.log(known[both] / view[both])[:: max(1, int(both.sum()) // LOOKED_AT)]
        if len(ratio) < LEAST:
            continue
        middle = float(np.median(ratio))
        if float(np.median(np.abs(ratio - middle))) <= np.log(MAX_FACTOR):
            found[index] = np.exp(middle)
    return found


def _certainty(confidence: Tensor, full: tuple[int, int]) -> NDArray[np.float32]:
    """(T, h, w) confidence of a head, from 1, as (T, H, W) in [0, ``GENERATED``]."""
    certain = resampled(confidence.float().cpu()[:, None], full)[:, 0]
    return (GENERATED * (1 - 1 / certain.clamp_min(1))).numpy().astype(np.float32)


def averaged(guidance: Guidance) -> Filled:
    """Projections filled as the model fills them, at their own size."""
    valid = torch.from_numpy(guidance.valid)[:, None]
    color = push_pull(torch.from_numpy(guidance.rgb).permute(0, 3, 1, 2), valid)
    depth = push_pull_depth(torch.from_numpy(guidance.depth)[:, None], valid)
    return Filled(color.permute(0, 2, 3, 1).numpy(), depth[:, 0].numpy())


def _plucker(
    ray: Tensor, world_from_first: NDArray[np.float64], unit: float, *, full: tuple[int, int]
) -> NDArray[np.float32]:
    """Predicted (T, h, w, 6) rays of the first view's frame as (T, H, W, 6) world Plücker rays."""
    maps = resampled(ray.float().cpu().permute(0, 3, 1, 2), full).permute(0, 2, 3, 1).double()
    rotation = torch.from_numpy(world_from_first[:3, :3].copy())
    direction = torch.nn.functional.normalize(maps[..., :3] @ rotation.T, dim=-1)
    origin = maps[..., 3:] * unit @ rotation.T
    origin = origin + torch.from_numpy(world_from_first[:3, 3].copy())
    moment = torch.linalg.cross(origin, direction)
    return torch.cat((direction, moment), -1).numpy().astype(np.float32)
