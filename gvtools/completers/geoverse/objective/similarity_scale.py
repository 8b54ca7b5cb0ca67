"""One scale a sample between predicted and reference cameras, by their centres.

(s*, Q*, b*) minimises sum_j |s Q o^_j + b - o_j|^2 over s > 0, Q in SO(3), b (appendix
"Scale-aligned depth supervision"). The scale, unlike the rotation, is determined by two centres or
by centres on a line, so these are solved; where the scale stays open the status says so, and its
numbers are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

DEFECTS = (
    "aligned",
    "fewer than 2 valid centres",
    "coincident predicted centres",
    "coincident reference centres",
    "unrelated centres",
)
# Spreads below this many roundings of the coordinates' magnitude are no geometry.
ROUNDINGS = 4


@dataclass(frozen=True, eq=False)
class CenterSimilarity:
    """reference ≈ scale · rotation · predicted + translation, for each sample.

    Attributes:
        scale: (B,) reference units per predicted unit; NaN where not ``ok``.
        rotation: (B, 3, 3) in SO(3); any of the best ones where the centres leave it open; NaN
            where not ``ok``.
        translation: (B, 3), reference units; NaN where not ``ok``.
        ok: (B,) bool, whether the scale holds.
        defect: (B,) int64, index into ``DEFECTS``.
        used: (B,) int64, centres the fit stands on.
        correlation: (B,) in [0, 1], 1 where the similarity maps the centres exactly; NaN where not
            ``ok``. The share of the reference's spread left over is 1 - correlation^2.
    """

    scale: Tensor
    rotation: Tensor
    translation: Tensor
    ok: Tensor
    defect: Tensor
    used: Tensor
    correlation: Tensor

    @property
    def status(self) -> tuple[str, ...]:
        """What ``DEFECTS`` says of each sample."""
        return tuple(DEFECTS[index] for index in self.defect.tolist())


@torch.no_grad()
def center_similarity(predicted: Tensor, reference: Tensor) -> CenterSimilarity:
    """Fit one similarity a sample, by centring and SVD of the cross-covariance.

    Solved in float64 on the CPU, a handful of numbers, so that every device gives the same scale.

    Args:
        predicted: (B, V, 3) camera centres o^; those that are not finite are left out.
        reference: (B, V, 3) camera centres o, any other frame and unit; likewise.
    """
    x, y = (z.to("cpu").to(torch.float64) for z in (predicted, reference))
    use = (x.isfinite() & y.isfinite()).all(-1)
    count = use.sum(1)
    x, x_center, x_flat = _centered(x, use, torch.finfo(predicted.dtype).eps)
    y, y_center, y_flat = _centered(y, use, torch.finfo(reference.dtype).eps)
    x_spread, y_spread = (x**2).sum((1, 2)), (y**2).sum((1, 2))

    covariance = y.mT @ x
    u, _, vt = torch.linalg.svd(covariance)
    sign = torch.ones_like(u[..., 0])
    sign[:, 2] = torch.where(torch.linalg.det(u) * torch.linalg.det(vt) < 0, -1.0, 1.0)
    rotation = (u * sign[:, None, :]) @ vt
    matched = (rotation * covariance).sum((1, 2))  # d_0 + d_1 ± d_2 >= 0
    size = (x_spread * y_spread).sqrt()
    coarsest = max(torch.finfo(z.dtype).eps for z in (predicted, reference))
    unrelated = matched <= ROUNDINGS * coarsest * size

    defect = torch.zeros_like(count)
    for index, holds in ((4, unrelated), (3, y_flat), (2, x_flat), (1, count < 2)):
        defect = torch.where(holds, index, defect)
    ok = defect == 0
    scale = matched / x_spread
    translation = y_center - scale[:, None] * (rotation @ x_center[..., None])[..., 0]
    wide = torch.promote_types(predicted.dtype, torch.float32)
    fitted = (
        torch.where(ok.reshape(-1, *(1,) * (value.ndim - 1)), value, torch.nan)
        for value in (scale, rotation, translation, (matched / size).clamp(max=1))
    )
    scale, rotation, translation, correlation = (
        value.to(wide).to(predicted.device) for value in fitted
    )
    return CenterSimilarity(
        scale, rotation, translation, ok.to(predicted.device), defect, count, correlation
    )


def _centered(points: Tensor, use: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor]:
    """Points about their centroid (0 where unused), the centroid, and whether they coincide."""
    points = torch.where(use[..., None], points, 0.0)
    count = use.sum(1).clamp(min=1)
    center = points.sum(1) / count[:, None]
    moved = torch.where(use[..., None], points - center[:, None], 0.0)
    rms = (moved.square().sum((1, 2)) / count).sqrt()
    return moved, center, rms <= ROUNDINGS * eps * points.abs().amax((1, 2))
