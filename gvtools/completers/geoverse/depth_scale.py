"""The model's depth in the memory's scale.

Three ways: one scale a pass from camera centres (Eq. "scale-aligned"), one robust scale a view from
the projected memory, or a smooth field of log ratios to it. Each is refused where nothing supports
it, and then the next one is tried. "centres-alone" is the paper's: always the first, whatever is
known; there is none where fewer than two centres stand apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.completers.base import ScaleAlignment, ScaleStatus
from gvtools.completers.geoverse.objective import center_similarity
from gvtools.completers.push_pull import push_pull
from gvtools.errors import DegenerateError
from gvtools.networks.depth_anything.geometry_head import ViewGeometry, camera_centres
from gvtools.similarity import ScaleFit, align_depth_scale

# Fewer centres fit each other by chance: of four at random, one set in a hundred correlates by more
# than 0.956, of three by 0.998, of two by 1.
MIN_CENTRES, MIN_CORRELATION = 4, 0.97
CENTRES_ALONE = "centres-alone"
# Depth that is off what is known by more than this factor, in the median, is refused where at least
# so many pixels know both.
MAX_FACTOR, MIN_SUPPORT = 1.35, 200
# Generated depth is smooth at a token's size: this far from the scale a pixel still follows it.
MAX_RESIDUAL, INLIER_BAND = 0.3, 0.15
# A log-ratio field that asks for more than this factor about its median is no scale error.
MAX_FIELD = 1.5
# A scale is fitted to about so many pixels.
FITTED = 100_000


@dataclass(frozen=True)
class ScaledDepth:
    """Depth in scene units, and how it got there."""

    # (T, H, W) z-depth; 0 where the model's is not finite, and for views without a supported scale.
    depth: NDArray[np.float32]
    # (T,) scene units per unit of the model, the field's median; NaN where refused.
    scale: NDArray[np.float64]
    alignment: tuple[ScaleAlignment, ...]  # for each view, what its scale rests on


@dataclass(frozen=True)
class PassScale:
    """One scale for all views of a pass."""

    scale: float  # scene units per unit of the model; NaN where refused
    # What it rests on: camera centres or the depth of the context, or why it is refused.
    status: ScaleStatus = ScaleStatus.CAMERA_CENTRES
    centres: int = 0  # camera centres that were compared; 0 where the predicted rays give none
    # Of predicted and given centres; NaN where they fit no similarity.
    correlation: float = float("nan")


def pass_scale(
    geometry: ViewGeometry,  # (1, V, ...) of a pass
    world_from_cam: NDArray[np.float64],  # (V, 4, 4), scene units
    # (C, H, W) depth of the context views at the model's size, scene units; 0 = none.
    known: NDArray[np.float32],
    *,
    alignment: str = "centres",
) -> PassScale:
    """s* from the camera centres, unless the context's own depth says otherwise."""
    if alignment == CENTRES_ALONE:
        return centre_scale(geometry, world_from_cam, min_centres=2, min_correlation=-1)
    centres = centre_scale(geometry, world_from_cam)
    generated = geometry.depth[0, : len(known)].float().cpu().numpy().astype(np.float64)
    fit = _fit_scale(generated, known, known > 0)
    if fit.support < 20 or int((known > 0).sum()) < MIN_SUPPORT:
        return centres
    if not fit.ok:
        return replace(centres, scale=np.nan, status=ScaleStatus.CONTRADICTED)
    apart = abs(np.log(centres.scale / fit.scale))
    if np.isfinite(apart) and apart <= np.log(MAX_FACTOR):
        return centres
    return replace(centres, scale=fit.scale, status=ScaleStatus.CONTEXT_DEPTH)


def centre_scale(
    geometry: ViewGeometry,
    world_from_cam: NDArray[np.float64],
    *,
    min_centres: int = MIN_CENTRES,
    min_correlation: float = MIN_CORRELATION,
) -> PassScale:
    """s* between predicted and requested camera centres (V), where they support it."""
    refused = PassScale(float("nan"), ScaleStatus.UNSUPPORTED)
    try:
        predicted = camera_centres(geometry.ray.float(), geometry.ray_confidence.float()).cpu()
    except DegenerateError:
        return refused
    reference = torch.from_numpy(np.ascontiguousarray(world_from_cam[None, :, :3, 3]))
    fit = center_similarity(predicted, reference)
    if not bool(fit.ok[0]):
        return refused
    found = PassScale(
        float(fit.scale[0]), centres=int(fit.used[0]), correlation=float(fit.correlation[0])
    )
    if found.centres < min_centres or found.correlation < min_correlation:
        return replace(found, scale=float("nan"), status=ScaleStatus.UNSUPPORTED)
    return found


def scale_depth(
    depth: Tensor,  # (T, H, W) of the model, at the hint's resolution
    hint: NDArray[np.float32],  # (T, H, W) the memory's depth, scene units
    valid: NDArray[np.bool_],  # (T, H, W) where it is known
    *,
    whole: PassScale,  # the scale of the pass
    alignment: str,  # "centres", "centres-alone", "hint" or "field"
) -> ScaledDepth:
    """Depth of target views in scene units."""
    unscaled = depth.float().cpu().numpy().astype(np.float32)
    result = np.zeros_like(unscaled)
    scale = np.full(len(unscaled), np.nan)
    alignments = []
    views = list(zip(unscaled, hint, valid, strict=True))
    # One scale a pass: a view that contradicts it refutes it for the others too.
    # No scale helps where scaled depth is far from the memory's.
    far = (_deviation(view * whole.scale, h, v)[0] > np.log(MAX_FACTOR) for view, h, v in views)
    if alignment != CENTRES_ALONE and any(far):
        whole = replace(whole, scale=float("nan"), status=ScaleStatus.CONTRADICTED)
    for index, (view, known, where) in enumerate(views):
        scale[index], outcome = _view_scale(view, known, where, whole=whole, alignment=alignment)
        alignments.append(outcome)
        if not outcome.accepted:
            continue
        result[index] = view * np.float32(scale[index])
        if outcome.status is ScaleStatus.MEMORY_FIELD:
            result[index] *= _field(result[index], known, where)
    result[~np.isfinite(result)] = 0
    return ScaledDepth(result, scale, tuple(alignments))


def _view_scale(
    depth: NDArray[np.float32],
    hint: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    whole: PassScale,
    alignment: str,
) -> tuple[float, ScaleAlignment]:
    """Scene units per unit of the model for one view, NaN where refused, and what it rests on."""
    fit = _fit_scale(depth, hint, valid)
    candidates = {
        "centres": (whole.scale, whole.status),
        "hint": (fit.scale, ScaleStatus.MEMORY_DEPTH),
        "field": (fit.scale, ScaleStatus.MEMORY_FIELD),
    }
    order = {
        "centres": ("centres", "hint"),
        "hint": ("hint", "centres"),
        "field": ("field", "hint", "centres"),
        CENTRES_ALONE: ("centres",),
    }[alignment]

    def outcome(
        status: ScaleStatus, scale: float, residual: float, *, overlap: int
    ) -> ScaleAlignment:
        support = (fit.inlier_share, whole.centres, whole.correlation)
        return ScaleAlignment(status, scale, residual, overlap, *support)

    for scale, status in (candidates[name] for name in order):
        deviation, overlap = _deviation(depth * scale, hint, valid)
        near = alignment == CENTRES_ALONE or not deviation > np.log(MAX_FACTOR)
        if np.isfinite(scale) and near:
            return scale, outcome(status, 1.0, float(np.expm1(deviation)), overlap=overlap)
    contradicted = np.isfinite(fit.residual) or whole.status is ScaleStatus.CONTRADICTED
    status = ScaleStatus.CONTRADICTED if contradicted else ScaleStatus.UNSUPPORTED
    return np.nan, outcome(status, np.nan, fit.residual, overlap=fit.support)


def _fit_scale(
    depth: NDArray[np.floating[Any]], known: NDArray[np.float32], valid: NDArray[np.bool_]
) -> ScaleFit:
    """The robust scale to what is known, on about ``FITTED`` pixels."""
    step = max(1, int((depth.size / FITTED) ** 0.5))
    at = (..., slice(None, None, step), slice(None, None, step))
    return align_depth_scale(
        depth[at],
        known[at],
        valid=valid[at],
        min_support=max(20, MIN_SUPPORT // step**2),
        max_residual=MAX_RESIDUAL,
        inlier_band=INLIER_BAND,
    )


def _deviation(
    depth: NDArray[np.floating[Any]], hint: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[float, int]:
    """Median |log ratio| of scaled depth to the memory's (NaN of few), and common pixels."""
    both = both_known(depth, hint, valid)
    overlap = int(both.sum())
    if overlap < MIN_SUPPORT:
        return float("nan"), overlap
    return float(np.median(np.abs(np.log(hint[both] / depth[both])))), overlap


def both_known(
    depth: NDArray[np.floating[Any]], hint: NDArray[np.float32], valid: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Pixels on which generated depth and the memory's, valid where it is, are both depths."""
    with np.errstate(invalid="ignore"):
        positive = (hint > 0) & (depth > 0)
    return np.asarray(valid & positive & np.isfinite(hint) & np.isfinite(depth))


def _field(
    depth: NDArray[np.float32], hint: NDArray[np.float32], valid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Exponential of the push-pull of log(hint / depth) over valid pixels, within ``MAX_FIELD``."""
    known = both_known(depth, hint, valid)
    limit = np.log(MAX_FIELD)
    ratio = np.zeros_like(depth)
    ratio[known] = np.clip(np.log(hint[known] / depth[known]), -limit, limit)
    filled = push_pull(torch.from_numpy(ratio)[None, None], torch.from_numpy(known)[None, None])
    return np.exp(filled[0, 0].numpy())
