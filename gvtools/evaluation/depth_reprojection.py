"""Depth reprojection between views: pixels and relative depth where two views see one surface.

Each pixel of the first view with known depth d₁ is lifted to a point X, which has depth z in the
second view and falls at q there. Second's own depth d₂ at q says what became of it (`Seen`). Where
both see one surface, two figures remain: the relative depth difference |z − d₂| / d₂, and the
forward-backward distance in pixels: q is lifted with d₂, projected into the first view, and
compared with where it started.

What the figures do not see: colours; along the line of sight, what the parallax between the views
does not show (without any, the distance is 0 whatever the depth; the relative depth is not); and
whatever differs by more than OCCLUSION, which leaves the co-visible set and raises the
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
from gvtools.evaluation.statistics import mean_of, median_of, share

# What a pair's distribution is kept as, to pool the medians of many pairs.
QUANTILES = 200
SHARES = {
    "covisible_share": Seen.COVISIBLE,
    "occluded_share": Seen.OCCLUDED,
    "contradicting_share": Seen.CONTRADICTING,
    "unknown_share": Seen.UNKNOWN,
}


@dataclass(frozen=True, kw_only=True)
class _Figures:
    """Agreement of depth. Figures that no pixel stands behind are None."""

    status: str  # "measured", or "empty: ..." with the reason why no pixel is co-visible
    covisible: int  # pixels that fall inside the second picture, on the surface that second sees
    # Forward-backward distance over the co-visible pixels, pixels of the first view.
    mean_pixels: float | None
    median_pixels: float | None
    mean_relative_depth: float | None  # |z − d₂| / d₂ over the co-visible pixels (0.01 = 1 %)
    median_relative_depth: float | None
    # Of the pixels inside: on second's surface, behind it, in front of it (in space that second
    # saw free), and where second has no depth.
    covisible_share: float | None
    occluded_share: float | None
    contradicting_share: float | None
    unknown_share: float | None

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

    pairs: tuple[DepthReprojection, ...]  # that were compared, those without overlap included
    without_overlap: tuple[tuple[str, str], ...]  # names of the pairs without a co-visible pixel


def depth_reprojection(first: PosedPicture, second: PosedPicture) -> DepthReprojection:
    """Follow first's pixels by their depth into second, and back by second's depth."""
    return _compare(first, second)[0]


def depth_reprojection_of_views(pictures: Sequence[PosedPicture]) -> DepthReprojectionOfViews:
    """Depth reprojection of each view into its successor along the path."""
    compared = [_compare(first, second) for first, second in pairwise(pictures)]
    pairs = [pair for pair, _, _ in compared]
    covisible = np.array([pair.covisible for pair in pairs], np.int64)
    inside = np.array([pair.inside for pair in pairs], np.int64)
    if not pairs:
        status = f"empty: {len(pictures)} view(s); at least 2 are needed"
    elif not covisible.any():
        status = f"empty: none of the {len(pairs)} pairs has a co-visible pixel"
    else:
        status = "measured"

    def pooled(name: str, weights: NDArray[np.int64]) -> float | None:
        weighed = zip([getattr(pair, name) for pair in pairs], weights.tolist(), strict=True)
        return share(sum(v * w for v, w in weighed if v is not None), int(weights.sum()))

    return DepthReprojectionOfViews(
        status=status,
        pairs=tuple(pairs),
        without_overlap=tuple((pair.first, pair.second) for pair in pairs if not pair.covisible),
        covisible=int(covisible.sum()),
        mean_pixels=pooled("mean_pixels", covisible),
        median_pixels=_pooled_median([pixels for _, pixels, _ in compared], covisible),
        mean_relative_depth=pooled("mean_relative_depth", covisible),
        median_relative_depth=_pooled_median([relative for *_, relative in compared], covisible),
        **{name: pooled(name, inside) for name in SHARES},
    )


def _compare(
    first: PosedPicture, second: PosedPicture
) -> tuple[DepthReprojection, Float64, Float64]:
    """The figures of a pair, and quantiles of its distances and of its relative differences."""
    seen = correspond(first, second)
    on = seen.seen == Seen.COVISIBLE
    inside = len(seen.seen) - seen.count(Seen.OUTSIDE)
    pixels = np.linalg.norm(seen.back[on] - seen.start[on], axis=-1)
    relative = np.abs(seen.z[on] / seen.depth[on] - 1)
    figures = DepthReprojection(
        first=first.name,
        second=second.name,
        status=_status(first, second, seen),
        known=len(seen.seen),
        inside=inside,
        covisible=int(on.sum()),
        mean_pixels=mean_of(pixels),
        median_pixels=median_of(pixels),
        mean_relative_depth=mean_of(relative),
        median_relative_depth=median_of(relative),
        **{name: share(seen.count(kind), inside) for name, kind in SHARES.items()},
    )
    return figures, _quantiles(pixels), _quantiles(relative)


def _status(first: PosedPicture, second: PosedPicture, seen: Correspondence) -> str:
    if seen.count(Seen.COVISIBLE):
        return "measured"
    if not len(seen.seen):
        return f"empty: {first.name} has no pixel with depth"
    if seen.count(Seen.OUTSIDE) == len(seen.seen):
        return f"empty: nothing of {first.name} falls inside {second.name}"
    if not known_depth(second)[0].any():
        return f"empty: {second.name} has no pixel with depth"
    return f"empty: {first.name} and {second.name} see no common surface"


def _quantiles(values: Float64) -> Float64:
    """Values that stand for equal parts of the distribution; none of none."""
    parts = (np.arange(QUANTILES) + 0.5) / QUANTILES
    return np.quantile(values, parts) if values.size else np.zeros(0)


def _pooled_median(quantiles: Sequence[Float64], weights: NDArray[np.int64]) -> float | None:
    """The median of all distributions together, each given by its quantiles and its size."""
    values = np.concatenate([np.zeros(0), *quantiles])
    if not values.size:
        return None
    sizes = [np.full(len(q), w) for q, w in zip(quantiles, weights, strict=True)]
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(np.concatenate(sizes)[order])
    return float(values[order[np.searchsorted(reached, 0.5 * reached[-1])]])
