"""The model's depth in the memory's scale.

Three ways, the first the paper's: one scale a pass from camera centres (Eq. "scale-aligned"), one
robust scale a view from the projected memory, or a smooth field of log ratios to it. Each is
refused where nothing supports it, and then the next one is asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.completers.geoverse.fill import push_pull
from gvtools.completers.geoverse.objective.similarity_scale import center_similarity
from gvtools.errors import DegenerateError, OptionError
from gvtools.networks.depth_anything.geometry_head import Geometry
from gvtools.networks.depth_anything.rays import camera_centres
from gvtools.similarity import ScaleFit, align_depth_scale

ALIGNMENTS = ("centres", "hint", "field")
# Fewer centres fit each other by chance: of four at random, one set in a hundred correlates by more
# than 0.956, of three by 0.998, of two by 1.
MIN_CENTRES, MIN_CORRELATION = 4, 0.97
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
    """Depth in scene units, and how it got there.

    Attributes:
        depth: (T, H, W) z-depth; 0 where the model's is not finite, and for views without a
            supported scale.
        scale: (T,) factor, the field's median; NaN where refused.
        method: for each view, what was used: one of ``ALIGNMENTS`` or "none".
    """

    depth: NDArray[np.float32]
    scale: NDArray[np.float64]
    method: tuple[str, ...]


@dataclass(frozen=True)
class PassScale:
    """One scale for all views of a pass.

    Attributes:
        scale: scene units per unit of the model; NaN where refused.
        by: "centres", "context" (the known depth of the context views), or "refused: ...".
    """

    scale: float
    by: str


def pass_scale(
    geometry: Geometry,
    world_from_cam: NDArray[np.float64],
    known: NDArray[np.float32],
) -> PassScale:
    """s* from the camera centres, unless the context's own depth says otherwise.

    Args:
        geometry: (1, V, ...) of a pass.
        world_from_cam: (V, 4, 4), scene units.
        known: (C, H, W) depth of the context views at the model's size, scene units; 0 = none.
    """
    centres, said = centre_scale(geometry, world_from_cam)
    made = geometry.depth[0, : len(known)].float().cpu().numpy().astype(np.float64)
    fitted = _fitted(made, known, known > 0)
    if fitted.support >= 20 and int((known > 0).sum()) >= MIN_SUPPORT:
        if not fitted.ok:
            return PassScale(np.nan, f"refused: the context's own depth is missed, {fitted.status}")
        if np.isfinite(centres) and abs(np.log(centres / fitted.scale)) <= np.log(MAX_FACTOR):
            return PassScale(centres, "centres")
        return PassScale(fitted.scale, "context")
    if np.isfinite(centres):
        return PassScale(centres, "centres")
    return PassScale(np.nan, f"refused: {said}")


def centre_scale(geometry: Geometry, world_from_cam: NDArray[np.float64]) -> tuple[float, str]:
    """s* between the predicted centres of all views and the requested ones, or NaN with a reason.

    Args:
        geometry: (1, V, ...) of a pass.
        world_from_cam: (V, 4, 4), scene units.
    """
    try:
        predicted = camera_centres(geometry.ray.float(), geometry.ray_confidence.float()).cpu()
    except DegenerateError as error:
        return float("nan"), str(error)
    reference = torch.from_numpy(np.ascontiguousarray(world_from_cam[None, :, :3, 3]))
    fitted = center_similarity(predicted, reference)
    if not bool(fitted.ok[0]):
        return float("nan"), fitted.status[0]
    used = int(fitted.used[0])
    if used < MIN_CENTRES:
        return float("nan"), f"{used} camera centres, at least {MIN_CENTRES} are needed"
    correlation = float(fitted.correlation[0])
    if correlation < MIN_CORRELATION:
        return float("nan"), f"centres correlate by {correlation:.2f}, below {MIN_CORRELATION}"
    return float(fitted.scale[0]), "aligned"


def scaled_depth(
    depth: Tensor,
    hint: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    centres: float,
    alignment: str,
) -> ScaledDepth:
    """Depth of target views in scene units.

    Args:
        depth: (T, H, W) of the model, at the hint's resolution.
        hint: (T, H, W) the memory's depth, scene units.
        valid: (T, H, W) where it is known.
        centres: scale from ``centre_scale``; NaN when refused.
        alignment: one of ``ALIGNMENTS``.

    Raises:
        OptionError: another alignment.
    """
    if alignment not in ALIGNMENTS:
        raise OptionError(f"alignment {alignment!r}; expected one of {', '.join(ALIGNMENTS)}")
    made = depth.float().cpu().numpy().astype(np.float32)
    result = np.zeros_like(made)
    scale = np.full(len(made), np.nan)
    methods = []
    # One scale a pass: a view that contradicts it refutes it for the others too.
    if any(_contradicts(v * centres, h, k) for v, h, k in zip(made, hint, valid, strict=True)):
        centres = float("nan")
    for index, view in enumerate(made):
        fitted = _fitted(view, hint[index], valid[index])
        order = {
            "centres": ("centres", "hint"),
            "hint": ("hint", "centres"),
            "field": ("field", "hint", "centres"),
        }[alignment]
        known = {"centres": centres, "hint": fitted.scale, "field": fitted.scale}
        method = next(
            (
                name
                for name in order
                if np.isfinite(known[name])
                and not _contradicts(view * known[name], hint[index], valid[index])
            ),
            "none",
        )
        methods.append(method)
        if method == "none":
            continue
        scale[index] = known[method]
        result[index] = view * np.float32(scale[index])
        if method == "field":
            result[index] *= _field(result[index], hint[index], valid[index])
    result[~np.isfinite(result)] = 0
    return ScaledDepth(result, scale, tuple(methods))


def _fitted(
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


def _contradicts(
    depth: NDArray[np.float64], hint: NDArray[np.float32], valid: NDArray[np.bool_]
) -> bool:
    """Whether scaled depth is far from the memory's where both are known: no scale then helps."""
    with np.errstate(invalid="ignore"):
        both = valid & (hint > 0) & (depth > 0) & np.isfinite(hint) & np.isfinite(depth)
    if both.sum() < MIN_SUPPORT:
        return False
    return float(np.median(np.abs(np.log(hint[both] / depth[both])))) > np.log(MAX_FACTOR)


def _field(
    depth: NDArray[np.float32], hint: NDArray[np.float32], valid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Exponential of the push-pull of log(hint / depth) over valid pixels, within ``MAX_FIELD``."""
    known = valid & (hint > 0) & (depth > 0) & np.isfinite(hint) & np.isfinite(depth)
    limit = np.log(MAX_FIELD)
    ratio = np.zeros_like(depth)
    ratio[known] = np.clip(np.log(hint[known] / depth[known]), -limit, limit)
    filled = push_pull(torch.from_numpy(ratio)[None, None], torch.from_numpy(known)[None, None])
    return np.exp(filled[0, 0].numpy())
