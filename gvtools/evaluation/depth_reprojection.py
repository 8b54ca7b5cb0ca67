"""Depth reprojection between views: pixels and relative depth where two views see one surface.

Each pixel of the first view with known depth d₁ is lifted to a point X, which has depth z in the
second view and falls at q there. Second's own depth d₂ at q says what became of it (`Seen`). Where
both see one surface, two figures remain: the relative depth difference |z − d₂| / d₂, and the
forward-backward distance in pixels: q is lifted with d₂, projected into the first view, and
compared with where it started.

What the figures do not see: colours; along the line of sight, what the parallax between the views
does not show (without any, the distance is 0 whatever the depth; the relative depth is not); and
whatever differs by more than ``occlusion``, which leaves the co-visible set and raises the
contradicting and occluded shares instead. So a pose that goes ever more wrong raises the two
figures up to a point only, while the contradicting share keeps growing. Read them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Float64
from gvtools.evaluation.posed_picture import (
    Correspondence,
    PosedPicture,
    Seen,
    correspond,
    known_depth,
)

# What a pair's distribution is kept as, to pool the medians of many pairs.
QUANTILES = 200


@dataclass(frozen=True, kw_only=True)
class _Figures:
    """Agreement of depth. Figures that no pixel stands behind are None."""

    status: str  # "measured", or "empty: ..." with the reason why no pixel is co-visible
    covisible: int  # pixels that fall inside the second picture, on the surface that second sees
    # Forward-backward distance over the co-visible pixels, pixels of the first view.
    mean_pixels: float | None
    median_pixels: float | None  # likewise
    mean_relative_depth: float | None  # |z − d₂| / d₂ over the co-visible pixels (0.01 = 1 %)
    median_relative_depth: float | None  # likewise
    covisible_share: float | None  # of the pixels inside
    occluded_share: float | None  # of the pixels inside: behind second's surface
    # Of the pixels inside: in front of it, in space that second saw free.
    contradicting_share: float | None
    unknown_share: float | None  # of the pixels inside: where second has no depth

    @property
    def ok(self) -> bool:
        """Whether there are co-visible pixels."""
        return self.status == "measured"


@dataclass(frozen=True, kw_only=True)
class DepthReprojection(_Figures):
    """Agreement of the depth of two views."""

    first: str  # name of the view whose pixels were reprojected
    second: str  # name of the view they were reprojected into
    known: int  # first's pixels with depth, inside its mask
    inside: int  # those that fall inside the second picture


@dataclass(frozen=True, kw_only=True)
class DepthReprojectionOfViews(_Figures):
    """Agreement over many pairs of views, each pair weighing as many pixels as it has.

    The medians' ranks are right to half a percent of the pixels.
    """

    # Every pair that was compared, those without overlap included.
    pairs: tuple[DepthReprojection, ...]
    # (first, second) names of the pairs that have no co-visible pixel.
    without_overlap: tuple[tuple[str, str], ...]


def depth_reprojection(
    first: PosedPicture, second: PosedPicture, *, occlusion: float = 0.05
) -> DepthReprojection:
    """Follow first's pixels by their depth into second, and back by second's depth.

    Both see one surface up to ``occlusion``, a relative difference of depth.
    """
    return _compare(first, second, occlusion)[0]


def depth_reprojection_of_views(
    pictures: Sequence[PosedPicture], *, occlusion: float = 0.05
) -> DepthReprojectionOfViews:
    """Depth reprojection of each view into its successor along the path."""
    found, pixels, relative = [], [], []
    for first, second in pairwise(pictures):
        figures, distances, differences = _compare(first, second, occlusion)
        found.append(figures)
        pixels.append(_quantiles(distances))
        relative.append(_quantiles(differences))
    covisible = np.array([pair.covisible for pair in found], np.int64)
    inside = np.array([pair.inside for pair in found], np.int64)
    if not found:
        status = f"empty: {len(pictures)} view(s); at least 2 are needed"
    elif not covisible.any():
        status = f"empty: none of the {len(found)} pairs has a co-visible pixel"
    else:
        status = "measured"
    return DepthReprojectionOfViews(
        status=status,
        pairs=tuple(found),
        without_overlap=tuple((pair.first, pair.second) for pair in found if not pair.covisible),
        covisible=int(covisible.sum()),
        mean_pixels=_weighted_mean([p.mean_pixels for p in found], covisible),
        median_pixels=_pooled_median(pixels, covisible),
        mean_relative_depth=_weighted_mean([p.mean_relative_depth for p in found], covisible),
        median_relative_depth=_pooled_median(relative, covisible),
        covisible_share=_weighted_mean([p.covisible_share for p in found], inside),
        occluded_share=_weighted_mean([p.occluded_share for p in found], inside),
        contradicting_share=_weighted_mean([p.contradicting_share for p in found], inside),
        unknown_share=_weighted_mean([p.unknown_share for p in found], inside),
    )


def _compare(
    first: PosedPicture, second: PosedPicture, occlusion: float
) -> tuple[DepthReprojection, Float64, Float64]:
    """The figures of a pair, and the distances and relative differences behind them."""
    found = correspond(first, second, occlusion=occlusion)
    on = found.seen == Seen.COVISIBLE
    inside = len(found.seen) - found.count(Seen.OUTSIDE)
    pixels = np.linalg.norm(found.back[on] - found.start[on], axis=-1)
    relative = np.abs(found.z[on] / found.depth[on] - 1)

    def share(kind: Seen) -> float | None:
        return found.count(kind) / inside if inside else None

    figures = DepthReprojection(
        first=first.name,
        second=second.name,
        status=_status(first, second, found),
        known=len(found.seen),
        inside=inside,
        covisible=int(on.sum()),
        mean_pixels=_mean(pixels),
        median_pixels=_median(pixels),
        mean_relative_depth=_mean(relative),
        median_relative_depth=_median(relative),
        covisible_share=share(Seen.COVISIBLE),
        occluded_share=share(Seen.OCCLUDED),
        contradicting_share=share(Seen.CONTRADICTING),
        unknown_share=share(Seen.UNKNOWN),
    )
    return figures, pixels, relative


def _status(first: PosedPicture, second: PosedPicture, found: Correspondence) -> str:
    if found.count(Seen.COVISIBLE):
        return "measured"
    if not len(found.seen):
        return f"empty: {first.name} has no pixel with depth"
    if found.count(Seen.OUTSIDE) == len(found.seen):
        return f"empty: nothing of {first.name} falls inside {second.name}"
    if not known_depth(second)[0].any():
        return f"empty: {second.name} has no pixel with depth"
    return f"empty: {first.name} and {second.name} see no common surface"


def _mean(values: Float64) -> float | None:
    return float(values.mean()) if values.size else None


def _median(values: Float64) -> float | None:
    return float(np.median(values)) if values.size else None


def _quantiles(values: Float64) -> Float64:
    """Values that stand for equal parts of the distribution; none of none."""
    parts = (np.arange(QUANTILES) + 0.5) / QUANTILES
    return np.quantile(values, parts) if values.size else np.zeros(0)


def _weighted_mean(values: Sequence[float | None], weights: NDArray[np.int64]) -> float | None:
    total = int(weights.sum())
    pairs = zip(values, weights.tolist(), strict=True)
    return sum(v * w for v, w in pairs if v is not None) / total if total else None


def _pooled_median(quantiles: Sequence[Float64], weights: NDArray[np.int64]) -> float | None:
    """The median of all distributions together, each given by its quantiles and its size."""
    values = np.concatenate([np.zeros(0), *quantiles])
    if not values.size:
        return None
    sizes = [np.full(len(q), w) for q, w in zip(quantiles, weights, strict=True)]
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(np.concatenate(sizes)[order])
    return float(values[order[np.searchsorted(reached, 0.5 * reached[-1])]])
