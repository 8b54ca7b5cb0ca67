"""One scale a sample between predicted and reference cameras, by their centres.

(s*, Q*, b*) minimises sum_j |s Q o^_j + b - o_j|^2 over s > 0, Q in SO(3), b (appendix
"Scale-aligned depth supervision"). The scale, unlike the rotation, is determined by two centres or
by centres on a line, so these are solved; what leaves the scale open is said, its numbers are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gvtools.errors import ShapeError

DEFECTS = (
    "aligned",
    "fewer than 2 valid centres",
    "coincident predicted centres",
    "coincident reference centres",
    "unrelated centres",
    "a scale that the type does not hold",
)
# Spreads below this many roundings of the coordinates' magnitude are no geometry.
ROUNDINGS = 4
# Differences of larger coordinates leave float64.
FARTHEST = 1e300


@dataclass(frozen=True, eq=False)
class CenterSimilarity:
    """reference ≈ scale · rotation · predicted + translation, for each sample.

    Attributes:
        scale: (B,) reference units per predicted unit, carries the gradient of the predicted
            centres; NaN where not ``ok``.
        rotation: (B, 3, 3) in SO(3), no gradient; any of the best ones where the centres leave it
            open; NaN where not ``ok``.
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


def center_similarity(
    predicted: Tensor, reference: Tensor, *, valid: Tensor | None = None
) -> CenterSimilarity:
    """Fit one similarity a sample, by centring and SVD of the cross-covariance.

    Solved in float64 on the CPU, a handful of numbers, so that every device gives the same scale.
    The scale's gradient is exact: at the optimum the rotation may be held fixed (d s* = <Q*, d C> /
    spread - s* d spread / spread), so no derivative of the SVD is taken and none can blow up.

    Args:
        predicted: (B, V, 3) camera centres o^.
        reference: (B, V, 3) camera centres o, any other frame and unit.
        valid: (B, V) bool; None takes all. Centres that are not finite, or beyond ``FARTHEST``,
            are left out as well; ``used`` says how many were left.
    """
    if predicted.ndim != 3 or predicted.shape[-1] != 3 or predicted.shape != reference.shape:
        raise ShapeError(
            f"camera centres: predicted {tuple(predicted.shape)}, reference "
            f"{tuple(reference.shape)}; expected both (B, V, 3)"
        )
    if valid is not None and (valid.shape != predicted.shape[:2] or valid.dtype != torch.bool):
        raise ShapeError(
            f"valid centres: {valid.dtype} {tuple(valid.shape)}; expected bool "
            f"{tuple(predicted.shape[:2])}"
        )
    x, y = (z.to("cpu").to(torch.float64) for z in (predicted, reference.detach()))
    use = ((x.detach().abs() < FARTHEST) & (y.abs() < FARTHEST)).all(-1)
    use = use if valid is None else use & valid.cpu()
    count = use.sum(1)
    x, x_center, x_power, x_flat = _centered(x, use, torch.finfo(predicted.dtype).eps)
    y, y_center, y_power, y_flat = _centered(y, use, torch.finfo(reference.dtype).eps)
    x_spread, y_spread = (x**2).sum((1, 2)), (y**2).sum((1, 2))

    covariance = y.mT @ x
    u, _, vt = torch.linalg.svd(covariance.detach())
    sign = torch.ones_like(u[..., 0])
    sign[:, 2] = torch.where(torch.linalg.det(u) * torch.linalg.det(vt) < 0, -1.0, 1.0)
    rotation = (u * sign[:, None, :]) @ vt
    matched = (rotation * covariance).sum((1, 2))  # d_0 + d_1 ± d_2 >= 0
    size = (x_spread * y_spread).sqrt()
    coarsest = max(torch.finfo(z.dtype).eps for z in (predicted, reference))
    unrelated = matched.detach() <= ROUNDINGS * coarsest * size.detach()

    defect = torch.zeros_like(count)
    for index, holds in ((4, unrelated), (3, y_flat), (2, x_flat), (1, count < 2)):
        defect = torch.where(holds, index, defect)
    ok = defect == 0
    scale = _by_power(matched / torch.where(ok, x_spread, 1.0), y_power - x_power)
    wide = torch.promote_types(predicted.dtype, torch.float32)
    translation = y_center - scale[:, None] * (rotation @ x_center[..., None])[..., 0]
    held = torch.cat((scale[:, None], translation), 1).detach().to(wide)
    ok = ok & held.isfinite().all(1) & (held[:, 0] > 0)
    defect = torch.where((defect == 0) & ~ok, 5, defect)
    correlation = (matched.detach() / torch.where(ok, size.detach(), 1.0)).clamp(max=1)

    def given(value: Tensor) -> Tensor:
        mask = ok.reshape(-1, *(1,) * (value.ndim - 1))
        return torch.where(mask, value, torch.nan).to(wide).to(predicted.device)

    return CenterSimilarity(
        given(scale),
        given(rotation),
        given(translation),
        ok.to(predicted.device),
        defect,
        count,
        given(correlation),
    )


def _centered(points: Tensor, use: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points about their centroid (0 where unused), the centroid, a power, and if they coincide.

    The power of two is divided out of the points, so that no square leaves float64.
    """
    points = torch.where(use[..., None], points, 0.0)
    share = use.to(points.dtype) / use.sum(1, keepdim=True).clamp(min=1)
    center = (share[..., None] * points).sum(1)
    moved = torch.where(use[..., None], points - center[:, None], 0.0)
    power = torch.frexp(moved.detach().abs().amax((1, 2))).exponent
    moved = _by_power(moved, -power[:, None, None])
    magnitude = _by_power(points.detach().abs().amax((1, 2)), -power)
    rms = (moved.detach().square().sum((1, 2)) / use.sum(1).clamp(min=1)).sqrt()
    return moved, center, power, rms <= ROUNDINGS * eps * magnitude


def _by_power(x: Tensor, power: Tensor) -> Tensor:
    """Times 2^power, in two halves, since the power itself may leave float64."""
    half = power // 2
    return x * torch.exp2(half.to(x.dtype)) * torch.exp2((power - half).to(x.dtype))
