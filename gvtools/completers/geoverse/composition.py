"""Decoded pictures and depth at the targets' own size, in the memory's scale and exposure.

A completion is the decoding itself (the paper), or a correction of the filled projection
(``composition``): decoded pictures are as sharp as a small network's decoder makes them, the filled
projection is as sharp as the memory. So the difference between the decoding of the model's features
and that of the projection's own is added to the projection. What it would change of the memory's
own pixels is continued through the holes and taken away, so that a hole's rim does not show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gvtools.cameras import Cameras
from gvtools.completers.base import Completion, ScaleAlignment, ScaleStatus, camera_rays
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.depth_scale import MAX_FACTOR, both_known, pass_scale, scale_depth
from gvtools.completers.geoverse.model import Decoded, Generated
from gvtools.completers.geoverse.refiner import Refiner, completed_views
from gvtools.completers.geoverse.views import resample, resample_depth
from gvtools.completers.push_pull import Filled, push_pull, push_pull_depth
from gvtools.guidance import Guidance

# Depth is corrected by at most this factor.
MOST = 1.5
# A correction of depth counts by what it exceeds this log-ratio: the surfaces that memory's are
# continued along are mostly right, to less than a small network can tell; where they are wrong, it
# is by much.
CERTAIN = 0.08
# The same factor while training: out of the way.
FAR = 1e3
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


def without_seams(values: Tensor, patch: int) -> Tensor:
    """Decoded pictures (N, C, H, W) of whole patches without the steps from patch to patch.

    A small decoder makes each patch by itself. Here the means of the patches are joined linearly,
    and what a patch shows around its mean stays. A pixel that is not finite stays so, alone.
    """
    finite = values.isfinite()
    share = F.avg_pool2d(finite.to(values.dtype), patch)
    mean = F.avg_pool2d(torch.where(finite, values, 0), patch) / share.clamp_min(1 / patch**2)
    size = (values.shape[-2], values.shape[-1])
    steps = F.interpolate(mean, size=size, mode="nearest")
    return values - steps + F.interpolate(mean, size=size, mode="bilinear", align_corners=False)


def remove_seams(made: Generated, patch: int) -> Generated:
    """A pass whose pictures are ``without_seams``."""

    def smooth(found: Decoded) -> Decoded:
        shape = found.rgb.shape[:2]
        rgb = without_seams(found.rgb.float().flatten(0, 1), patch).unflatten(0, shape)
        return replace(found, rgb=rgb)

    hint = None if made.hint is None else smooth(made.hint)
    return replace(made, decoded=smooth(made.decoded), hint=hint)


def correct_color(filled: Tensor, made: Tensor, hint: Tensor, *, valid: Tensor) -> Tensor:
    """The filled projection plus what the model changed, (N, 3, H, W) each; not clipped to [0, 1].

    A pixel that is not finite in either decoding stays so, alone. ``valid`` is (N, 1, H, W).
    """
    change = made - hint
    known = valid & change.isfinite().all(1, keepdim=True)
    return filled + change - push_pull(change, known)


def correct_depth(
    filled: Tensor,  # (N, 1, H, W) z-depth, scene units; 0 = none, and stays so
    made: Tensor,  # likewise, model units, above 0
    hint: Tensor,  # likewise
    *,
    valid: Tensor,  # (N, 1, H, W) bool, where the memory knows
    certain: float = CERTAIN,  # log-ratio that a correction counts from
    most: float = MOST,  # largest factor
) -> Tensor:
    """The filled projection's depth by the ratio of two decodings.

    A pixel without a ratio (NaN, or 0 in both) is NaN, alone.
    """
    change = made.log() - hint.log()
    change = change - push_pull(change, valid & change.isfinite())
    if certain > 0:
        change = torch.where(change.abs() > certain, change - certain * change.sign(), 0 * change)
    limit = math.log(most)
    return filled * change.clamp(-limit, limit).exp()


def compose(batch: ViewBatch, made: Decoded, hint: Decoded | None) -> tuple[Tensor, Tensor]:
    """Pictures (B, T, 3, H, W) and depth (B, T, H, W) of the targets, as training judges them.

    At the model's size, every correction of depth counting in full; ``batch`` is filled as the
    model saw it. Without a ``hint`` it is the decoding itself.
    """
    rgb, depth = made.rgb.float(), made.depth
    if hint is None:
        return rgb, depth
    shape = rgb.shape[:2]
    filled, known, valid = (
        value[:, batch.context :].flatten(0, 1)
        for value in (batch.images, batch.depth, batch.valid)
    )
    color = correct_color(filled, rgb.flatten(0, 1), hint.rgb.float().flatten(0, 1), valid=valid)
    first, second = (found.depth.flatten(0, 1)[:, None] for found in (made, hint))
    # The smallest corrections and the worst would have no gradient.
    length = correct_depth(known, first, second, valid=valid, certain=0.0, most=FAR)
    mask = (known > 0).unflatten(0, shape)
    color, length = color.unflatten(0, shape), length.unflatten(0, shape)
    return torch.where(mask, color, rgb), torch.where(mask[:, :, 0], length[:, :, 0], depth)


@dataclass(frozen=True)
class Completed:
    """A pass's result at the targets' size and in scene units."""

    rgb: NDArray[np.float32]  # (T, H, W, 3) in [0, 1]
    depth: NDArray[np.float32]  # (T, H, W) z-depth; 0 = none
    confidence: NDArray[np.float32]  # (T, H, W) in [0, 1]; 0 where there is no depth
    # (T, H, W, 6) predicted Plücker rays, world frame; None without a scale, or if not asked for.
    rays: NDArray[np.float32] | None
    scales: NDArray[np.float64]  # (T,) scene units per unit of the model; NaN where refused
    alignment: tuple[ScaleAlignment, ...]  # for each view, what its scale rests on

    def over(self, guidance: Guidance, *, whole: bool) -> Completion:
        """The memory's pixels with these in its holes; these everywhere if ``whole``."""
        hole = np.ones_like(guidance.valid) if whole else ~guidance.valid
        known = Completion.of_memory(guidance)
        rays = camera_rays(guidance.cameras, known.depth.shape)
        if self.rays is not None:
            scaled = hole & np.isfinite(self.scales)[:, None, None]
            rays[scaled] = self.rays[scaled]
        for image in ("rgb", "depth", "confidence"):
            getattr(known, image)[hole] = getattr(self, image)[hole]
        return replace(known, rays=rays, scale_alignment=self.alignment, whole=whole)


def to_scene_scale(
    generated: Generated,
    guidance: Guidance,  # its targets' projections
    cameras: Cameras,  # of all views, at the model's size
    *,
    known: NDArray[np.float32],  # (C, h, w) depth of the context at the model's size
    alignment: str,  # see ``depth_scale``
    color_alignment: str,  # "field" for ``align_color``, or "unchanged"
) -> Completed:
    """Pictures, depth, confidence and rays of the targets at their own size, in scene units."""
    geometry, context = generated.decoded.geometry, len(known)
    full = (guidance.depth.shape[1], guidance.depth.shape[2])
    rgb = resample(generated.decoded.rgb[0].float().cpu(), full).clamp(0, 1)
    if color_alignment == "field":
        hint = torch.from_numpy(guidance.rgb).permute(0, 3, 1, 2)
        rgb = align_color(rgb, hint, torch.from_numpy(guidance.valid)[:, None])
    depth = resample_depth(generated.decoded.depth[0].float().cpu(), full)
    world_from_cam = cameras.world_from_cam
    whole = pass_scale(geometry, world_from_cam, known, alignment=alignment)
    # A pixel without a colour has no depth either: nothing of it enters the memory.
    depth = torch.where(rgb.isfinite().all(1), depth, torch.nan)
    scaled = scale_depth(depth, guidance.depth, guidance.valid, whole=whole, alignment=alignment)
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


def align_color(rgb: Tensor, hint: Tensor, valid: Tensor) -> Tensor:
    """Pictures (T, 3, H, W) plus the push-pull of ``hint - rgb`` over valid pixels, in [0, 1].

    What a small network decodes is off by a little all over, and a hole's fill then shows its rim.
    A pixel that is not finite stays so.
    """
    known = valid & torch.isfinite(rgb).all(1, keepdim=True)
    offset = push_pull(torch.where(known, hint - rgb, 0.0), known)
    return (rgb + offset).clamp(0, 1)


def correct(
    generated: Generated, guidance: Guidance, fill: Filled, *, back: Completed | None = None
) -> Completed:
    """The filled projection with what the model changed, in views that memory tells of.

    ``back`` stands where the fill has no depth; None where it has depth everywhere.
    """
    assert generated.hint is not None
    full = (guidance.depth.shape[1], guidance.depth.shape[2])
    color, length = torch.from_numpy(fill.rgb).permute(0, 3, 1, 2), torch.from_numpy(fill.depth)
    decoded = (generated.decoded, generated.hint)
    colors = [resample(found.rgb[0].float().cpu(), full) for found in decoded]
    depths = [resample_depth(found.depth[0].float().cpu(), full)[:, None] for found in decoded]
    valid = torch.from_numpy(guidance.valid)[:, None]
    rgb = correct_color(color, *colors, valid=valid).clamp(0, 1).permute(0, 2, 3, 1)
    depth = correct_depth(length[:, None], *depths, valid=valid)[:, 0]
    known = ((length > 0) & rgb.isfinite().all(-1) & depth.isfinite()).numpy()
    scales = depth_ratios(guidance, depths[0][:, 0].numpy())
    if back is None:
        nothing, picture = np.zeros(known.shape, np.float32), np.zeros_like(fill.rgb)
        unknown = (ScaleAlignment(ScaleStatus.UNSUPPORTED, np.nan),) * len(scales)
        back = Completed(picture, nothing, nothing, None, scales, unknown)
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
def refine(
    completed: Completed,  # at the targets' size
    guidance: Guidance,  # the targets' projections
    refiner: Refiner,  # on the device of the pass
    *,
    batch: ViewBatch,  # filled as the model saw it (``conditioning.fill_holes``)
    generated: Generated,  # of the pass, with the hints' decoding
) -> Completed:
    """Completed views with the refiner's colours, and its confidence, in their holes."""
    full = (guidance.depth.shape[1], guidance.depth.shape[2])
    made, _ = compose(batch, generated.decoded, generated.hint)
    finite = made.isfinite()
    found = refiner(completed_views(batch, torch.where(finite, made, 0.0)))
    found = replace(found, **{name: values.cpu() for name, values in vars(found).items()})
    valid = torch.from_numpy(guidance.valid)[:, None]
    rgb = torch.from_numpy(completed.rgb).permute(0, 3, 1, 2)
    rgb = found.colors(rgb, valid).clamp(0, 1)
    right = resample(found.depth_right, full).sigmoid()[:, 0].numpy()
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
    """(T,) scene units per unit of a view's depth; NaN where no factor brings them together."""
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
    certain = resample(confidence.float().cpu()[:, None], full)[:, 0]
    return (GENERATED * (1 - 1 / certain.clamp_min(1))).numpy().astype(np.float32)


def average_fill(guidance: Guidance) -> Filled:
    """Projections filled as the model fills them, at their own size."""
    valid = torch.from_numpy(guidance.valid)[:, None]
    color = push_pull(torch.from_numpy(guidance.rgb).permute(0, 3, 1, 2), valid)
    depth = push_pull_depth(torch.from_numpy(guidance.depth)[:, None], valid)
    return Filled(color.permute(0, 2, 3, 1).numpy(), depth[:, 0].numpy())


def _plucker(
    ray: Tensor, world_from_first: NDArray[np.float64], unit: float, *, full: tuple[int, int]
) -> NDArray[np.float32]:
    """Predicted (T, h, w, 6) rays of the first view's frame as (T, H, W, 6) world Plücker rays."""
    maps = resample(ray.float().cpu().permute(0, 3, 1, 2), full).permute(0, 2, 3, 1).double()
    rotation = torch.from_numpy(world_from_first[:3, :3].copy())
    direction = torch.nn.functional.normalize(maps[..., :3] @ rotation.T, dim=-1)
    origin = maps[..., 3:] * unit @ rotation.T
    origin = origin + torch.from_numpy(world_from_first[:3, 3].copy())
    moment = torch.linalg.cross(origin, direction)
    return torch.cat((direction, moment), -1).numpy().astype(np.float32)
