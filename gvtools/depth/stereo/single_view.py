"""Depth of one reference view from its sources, before other views' depth is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from gvtools.cameras import Cameras, concatenate
from gvtools.depth.stereo.depth_range import DepthRange, range_of_depths
from gvtools.depth.stereo.hypotheses import Hypotheses, best_plane, plane_hypotheses
from gvtools.depth.stereo.matching import Level, Matcher
from gvtools.depth.stereo.options import StereoOptions
from gvtools.depth.stereo.pyramid import Pyramid, level_of
from gvtools.depth.stereo.refinement import fitted, refined, upsampled
from gvtools.depth.stereo.texture import textured

# Cost below which a first estimate tells the range of depths, and the share of pixels it needs.
SURE, SURE_SHARE = 0.3, 0.1


@dataclass(frozen=True, eq=False)
class CoarseDepth:
    """What the coarsest level tells.

    Attributes:
        level: its pictures.
        hypotheses: the planes that were tried.
        inverse_depth: (H, W) float32, 1 / scene units.
        cost: (H, W) float32 photometric cost there.
    """

    level: Level
    hypotheses: Hypotheses
    inverse_depth: torch.Tensor
    cost: torch.Tensor


@dataclass(frozen=True, eq=False)
class RawDepth:
    """Depth of one view on the finest level; every pixel has some.

    Attributes:
        inverse_depth: (H, W) float32, 1 / scene units.
        cost: (H, W) float32 photometric cost.
        textured: (H, W) bool, where there is detail to match; see gvtools.depth.stereo.texture.
        camera: of the finest level, a batch of one.
        sources: names of the views that it was matched with.
    """

    inverse_depth: torch.Tensor
    cost: torch.Tensor
    textured: torch.Tensor
    camera: Cameras
    sources: tuple[str, ...]


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


def narrowed(depths: DepthRange, coarse: CoarseDepth) -> DepthRange:
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
    planes = fitted(coarse.inverse_depth, (1 - coarse.cost).clamp(min=0.01))
    level, cost = coarse.level, coarse.cost
    inverse = coarse.hypotheses.inverse_depths
    bounds = (float(inverse[0]), float(inverse[-1]))
    step = coarse.hypotheses.step
    for index in range(len(reference.images) - 1, -1, -1):
        if index < len(reference.images) - 1:
            level = level_of(reference, sources, index, window=options.window, device=device)
            planes = upsampled(planes, *level.reference.shape)
            step /= 2
        planes, cost = refined(
            planes, level, matcher,
            step=step, bounds=bounds, iterations=options.iterations * 2**index,
        )  # fmt: skip
    detailed = textured(level.reference, window=options.window, noise=options.noise)
    return RawDepth(planes[0].clamp(*bounds), cost, detailed, reference.cameras[0], names)
