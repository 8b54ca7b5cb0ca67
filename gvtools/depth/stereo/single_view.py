"""Depth of one view from its sources: a coarse sweep, then planes carried to finer levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.geometry import (
    DepthRange,
    Hypotheses,
    best_plane,
    disparity_rate,
    parabola,
    plane_hypotheses,
    range_of_depths,
)
from gvtools.depth.stereo.matching import Level, Matcher, Pyramid, level_of, textured

# A new plane must be better by this much; ties keep what came from the coarser level.
GAIN = 0.004
FIT_RADIUS = 3
# Cost below which a first estimate tells the range of depths, and the share of pixels it needs.
SURE, SURE_SHARE = 0.3, 0.1
# Pixels by which the nearest depth must move in a source against infinity.
LEAST_DISPARITY = 0.5
# Below which a pixel is matched at all; by how much depth must match better than a turn alone; and
# the share of the matched pixels that have to.
MATCHED, BETTER, BETTER_SHARE = 0.3, 0.02, 0.05


def upsample(planes: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """The planes (3, h, w) of a coarser level, see Matcher.score, at the pixels of a finer one."""
    device = planes.device
    down, across = planes.shape[1] / height, planes.shape[2] / width
    y = (torch.arange(height, device=device) + 0.5) * down
    x = (torch.arange(width, device=device) + 0.5) * across
    row = y.long().clamp(max=planes.shape[1] - 1)
    column = x.long().clamp(max=planes.shape[2] - 1)
    near = planes[:, row][:, :, column]
    dy, dx = (y - row - 0.5)[:, None], (x - column - 0.5)[None]
    return torch.stack([near[0] + near[1] * dx + near[2] * dy, near[1] * across, near[2] * down])


def fit_planes(
    inverse_depth: torch.Tensor, weight: torch.Tensor, *, radius: int = FIT_RADIUS
) -> torch.Tensor:
    """The plane that fits the inverse depths round each pixel best, by weighted least squares.

    (3, H, W), see Matcher.score. Without enough weight in reach, the plane is parallel to the
    image.
    """
    size = 2 * radius + 1
    offset = torch.arange(-radius, radius + 1, device=weight.device, dtype=weight.dtype)
    one = torch.ones_like(offset)
    # Differences to the centre's value: the sums stay exact when all inverse depths are alike.
    base = inverse_depth.mean()
    value = (inverse_depth - base) * weight

    def total(image: torch.Tensor, down: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        padded = F.pad(image[None, None], (radius,) * 4)
        summed = F.conv2d(padded, down.view(1, 1, size, 1))
        return F.conv2d(summed, across.view(1, 1, 1, size))[0, 0]

    n = total(weight, one, one).clamp(min=1e-6)
    mx, my = total(weight, one, offset) / n, total(weight, offset, one) / n
    mw = total(value, one, one) / n
    xx = total(weight, one, offset**2) / n - mx * mx
    yy = total(weight, offset**2, one) / n - my * my
    xy = total(weight, offset, offset) / n - mx * my
    xw = total(value, one, offset) / n - mx * mw
    yw = total(value, offset, one) / n - my * mw
    # A little ridge: where the weights lie on a line, the slope across it is 0.
    xx, yy = xx + 0.05, yy + 0.05
    determinant = xx * yy - xy * xy
    a, b = (yy * xw - xy * yw) / determinant, (xx * yw - xy * xw) / determinant
    some = n > 1.5
    a, b = a * some, b * some
    w = torch.where(some, mw + base - a * mx - b * my, inverse_depth)
    return torch.stack([w, a, b])


def refine_planes(
    planes: torch.Tensor,
    level: Level,
    matcher: Matcher,
    *,
    step: float,
    bounds: tuple[float, float],
    iterations: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Propagate, adjust and refine planes (3, H, W) on one level; gives them and their costs.

    All pixels take the same kind of proposal at once: a neighbour's plane, a shifted plane, the
    plane fitted to the surroundings. What lowers the photometric cost is kept. Proposals follow
    each other, so planes travel several pixels per round. Nothing is drawn at random. ``step``:
    inverse depth that moves one pixel in the source that moves most.
    """
    planes = planes.clone()
    planes[0].clamp_(*bounds)
    cost = matcher.score(level, planes)

    def offer(proposal: torch.Tensor) -> None:
        nonlocal planes, cost
        proposal[0].clamp_(*bounds)
        price = matcher.score(level, proposal)
        better = price < cost - GAIN
        cost = torch.where(better, price, cost)
        planes = torch.where(better, proposal, planes)

    for i in range(iterations):
        reach = 1 if i % 2 == 0 else 3
        for dy, dx in ((0, reach), (reach, 0), (0, -reach), (-reach, 0)):
            offer(_shift(planes, dy, dx))
        offer(fit_planes(planes[0], (1 - cost).clamp(min=0.01)))
        for change in (0.5, -0.5) if i % 2 == 0 else (0.25, -0.25):
            offer(torch.stack([planes[0] + change * step, planes[1], planes[2]]))
    return _between(planes, cost, level, matcher=matcher, step=0.4 * step)


def _shift(planes: torch.Tensor, dy: int, dx: int) -> torch.Tensor:
    """Each pixel's neighbour's plane, continued to the pixel; the border keeps its own."""
    moved = planes.roll((dy, dx), dims=(1, 2))
    moved[0] += moved[1] * dx + moved[2] * dy
    if dy:
        edge = slice(0, dy) if dy > 0 else slice(dy, None)
        moved[:, edge] = planes[:, edge]
    if dx:
        edge = slice(0, dx) if dx > 0 else slice(dx, None)
        moved[:, :, edge] = planes[:, :, edge]
    return moved


def _between(
    planes: torch.Tensor, cost: torch.Tensor, level: Level, *, matcher: Matcher, step: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The inverse depths moved to the lowest point of a parabola through three costs."""
    sides = [
        matcher.score(level, torch.stack([planes[0] + side * step, planes[1], planes[2]]))
        for side in (-1, 1)
    ]
    shift = parabola(sides[0], cost, sides[1])
    return torch.stack([planes[0] + shift * step, planes[1], planes[2]]), cost


@dataclass(frozen=True, eq=False)
class CoarseDepth:
    """What the coarsest level tells."""

    level: Level  # its pictures
    hypotheses: Hypotheses  # the planes that were tried
    inverse_depth: torch.Tensor  # (H, W) float32, 1 / scene units
    cost: torch.Tensor  # (H, W) float32 photometric cost there


@dataclass(frozen=True, eq=False)
class RawDepth:
    """Depth of one view on the finest level; every pixel has some."""

    inverse_depth: torch.Tensor  # (H, W) float32, 1 / scene units
    cost: torch.Tensor  # (H, W) float32 photometric cost
    textured: torch.Tensor  # (H, W) bool, where there is detail to match; see ``textured``
    camera: Cameras  # of the finest level, a batch of one
    sources: tuple[str, ...]  # names of the views that it was matched with


def coarse_depth(
    reference: Pyramid,
    sources: Sequence[Pyramid],
    depths: DepthRange,
    *,
    options: StereoOptions,
    matcher: Matcher,
    device: torch.device,
) -> CoarseDepth:
    """Sweep planes over the coarsest level and aggregate their costs."""
    index = len(reference.images) - 1
    level = level_of(reference, sources, index, window=options.window, device=device)
    cameras = concatenate(
        [source.cameras[min(index, len(source.cameras) - 1)] for source in sources]
    )
    planes = plane_hypotheses(reference.cameras[index], cameras, depths, planes=options.planes)
    volume = matcher.sweep(level, planes.inverse_depths.to(device))
    inverse_depth, which = best_plane(matcher.aggregate(volume, level.reference), planes)
    cost = volume.gather(-1, which[..., None])[..., 0]
    return CoarseDepth(level, planes, inverse_depth, cost)


def narrow_range(depths: DepthRange, coarse: CoarseDepth) -> DepthRange:
    """The range that the surely matched pixels of a first sweep span; the old one without them."""
    sure = coarse.cost < SURE
    if sure.float().mean() < SURE_SHARE:
        return depths
    found = (1 / coarse.inverse_depth[sure]).double().cpu().numpy()
    return range_of_depths(found, origin="pictures")


def fine_depth(
    coarse: CoarseDepth,
    reference: Pyramid,
    sources: Sequence[Pyramid],
    *,
    names: tuple[str, ...],
    options: StereoOptions,
    matcher: Matcher,
    device: torch.device,
) -> RawDepth:
    """Carry a coarse estimate to the finest level, adjusting it on each.

    Rounds of propagation double from a level to the coarser one, where they cost a quarter.
    """
    planes = fit_planes(coarse.inverse_depth, (1 - coarse.cost).clamp(min=0.01))
    level, cost = coarse.level, coarse.cost
    inverse = coarse.hypotheses.inverse_depths
    bounds = (float(inverse[0]), float(inverse[-1]))
    step = coarse.hypotheses.step
    for index in range(len(reference.images) - 1, -1, -1):
        if index < len(reference.images) - 1:
            level = level_of(reference, sources, index, window=options.window, device=device)
            planes = upsample(planes, *level.reference.shape)
            step /= 2
        planes, cost = refine_planes(
            planes, level, matcher,
            step=step, bounds=bounds, iterations=options.iterations * 2**index,
        )  # fmt: skip
    detailed = textured(level.reference, window=options.window, noise=options.noise)
    return RawDepth(planes[0].clamp(*bounds), cost, detailed, reference.cameras[0], names)


def enough_disparity(reference: Cameras, sources: Cameras, depths: DepthRange) -> NDArray[np.bool_]:
    """(S,) whether each source sees the nearest depth move at all, on the finest level."""
    rate = disparity_rate(reference, sources, depths.near, far=np.inf)
    return rate / depths.near >= LEAST_DISPARITY


def only_turned(
    level: Level, cost: torch.Tensor, textured: torch.Tensor, *, matcher: Matcher
) -> bool:
    """Whether a turn of the camera explains the pictures as well as any depth does.

    Infinite depth moves pixels by the turn alone. Where cameras moved next to nothing, it matches
    every pixel at least as well as the depth that was found, of ``cost`` (H, W).
    """
    turned = matcher.sweep(level, torch.zeros(1, device=cost.device))[..., 0]
    matched = textured & (torch.minimum(cost, turned) < MATCHED)
    if not matched.any():
        return False
    return float((turned - cost > BETTER)[matched].float().mean()) < BETTER_SHARE
