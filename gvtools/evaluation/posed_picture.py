"""Posed pictures, the correspondence of their pixels by depth, and depth reprojection.

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
from enum import IntEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, invert_rigid
from gvtools.evaluation.statistics import mean_of, median_of, share

# Relative difference of depth up to which two depths are of one surface.
OCCLUSION = 0.05


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One view, observed or generated."""

    name: str  # the view's
    camera: Cameras  # a batch of one, where the picture is meant to be seen from
    rgb: NDArray[np.uint8]  # (H, W, 3) uint8
    # (H, W) float32 z-depth, scene units, 0 = none; None when there is none.
    depth: NDArray[np.float32] | None = None
    mask: NDArray[np.bool_] | None = None  # (H, W) bool, True = use; None means all


class Seen(IntEnum):
    """What the second view says about a pixel of the first."""

    OUTSIDE = 0  # beside second's picture, or behind its camera
    UNKNOWN = 1  # second has no depth there, or masks it
    OCCLUDED = 2  # behind the surface that second sees
    CONTRADICTING = 3  # in front of it: second looked through the place and saw nothing
    COVISIBLE = 4  # on it


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Where N pixels of the first view lie in the second."""

    rows: NDArray[np.int64]  # (N,) of the first view's pixels
    columns: NDArray[np.int64]  # (N,)
    xy: Float64  # (N, 2) their places in the second view, pixels; NaN where OUTSIDE
    z: Float64  # (N,) their depth in the second view, scene units
    depth: Float64  # (N,) second's own depth at these places, scene units; 0 where none
    # (N, 2) where the first view sees what second's depth puts at these places, pixels of the first
    # view; NaN where second has no depth, or where that lies behind the first camera.
    back: Float64
    seen: NDArray[np.uint8]  # (N,) values of `Seen`

    @property
    def start(self) -> Float64:
        """(N, 2) centres of the first view's pixels, pixels."""
        return _centers(self.rows, self.columns)

    def count(self, kind: Seen) -> int:
        """How many pixels are of a kind."""
        return int(np.count_nonzero(self.seen == kind))


def correspond(
    first: PosedPicture,
    second: PosedPicture,
    *,
    where: NDArray[np.bool_] | None = None,
) -> Correspondence:
    """Project first's known pixels into second, compare the depth there, and come back with it.

    Second's depth at a place between its pixels is interpolated bilinearly in 1/depth, which is
    exact on a plane, wherever the four neighbours are known and lie on one surface: their depths
    differ by no more than OCCLUSION, |z / depth - 1|. Elsewhere it is that of the nearest
    pixel. The pixels of first may be limited by an (H, W) mask, ``where``.
    """
    wanted, depth = known_depth(first)
    if where is not None:
        wanted = wanted & where
    rows, columns = np.nonzero(wanted)
    start = _centers(rows, columns)
    xy, z = _carry(first.camera, second.camera, start, depth=depth[rows, columns])
    size = np.array([second.camera.width[0], second.camera.height[0]])
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & ((xy >= 0) & (xy < size)).all(-1)
    xy[~inside] = np.nan

    known, second_depth = known_depth(second)
    there = np.zeros(len(z))
    there[inside] = _sample(
        np.where(known, second_depth, 0),
        xy[inside],
    )
    back = np.full_like(xy, np.nan)
    found = there > 0
    back[found], ahead = _carry(second.camera, first.camera, xy[found], depth=there[found])
    back[found] = np.where(ahead[:, None] > 0, back[found], np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = z / there
    seen = np.full(len(z), Seen.COVISIBLE, np.uint8)
    # What second's depth puts behind the first camera is not what that camera saw, however near.
    astray = np.isnan(back[:, 0])
    seen[(ratio > 1 + OCCLUSION) | (astray & (ratio > 1))] = Seen.OCCLUDED
    seen[(ratio < 1 - OCCLUSION) | (astray & (ratio <= 1))] = Seen.CONTRADICTING
    seen[~found] = Seen.UNKNOWN
    seen[~inside] = Seen.OUTSIDE
    return Correspondence(rows, columns, xy, z, there, back, seen)


def known_depth(picture: PosedPicture) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """(H, W) bool, which pixels have a depth to use (finite, above 0, in the mask), and the depth.

    A picture without depth has no such pixel, and depth 0.
    """
    depth = picture.depth
    if depth is None:
        depth = np.zeros(picture.rgb.shape[:2], np.float32)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(depth) & (depth > 0)
    return known if picture.mask is None else known & picture.mask, depth


def _centers(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Float64:
    return np.stack([columns, rows], axis=-1).astype(np.float64) + 0.5


def _carry(
    source: Cameras, target: Cameras, xy: Float64, *, depth: NDArray[np.floating]
) -> tuple[Float64, Float64]:
    """Lift (N, 2) places of one view by their (N,) depth: their places and depth in another.

    The poses are chained before they meet the points, so that far world origins cost no digits.
    """
    move = (target.cam_from_world @ invert_rigid(source.cam_from_world))[0]
    lift = move[:3, :3] @ np.linalg.inv(source.K[0])
    points = xy @ lift[:, :2].T + lift[:, 2]
    points = points * np.asarray(depth, np.float64)[:, None] + move[:3, 3]
    image = points @ target.K[0].T
    with np.errstate(divide="ignore", invalid="ignore"):
        return image[:, :2] / image[:, 2:], points[:, 2]


def _sample(depth: NDArray[np.float32], xy: Float64) -> Float64:
    """Depth (H, W; 0 = none) at (N, 2) places inside the picture; 0 where there is none."""
    height, width = depth.shape
    flat = depth.ravel()
    column, row = xy.astype(np.int64).T
    out = flat[row * width + column].astype(np.float64)

    corner = np.floor(xy - 0.5).astype(np.int64)
    whole = np.flatnonzero(((corner >= 0) & (corner < (width - 1, height - 1))).all(-1))
    left, top = corner[whole].T
    base = top * width + left
    four = flat[np.stack([base, base + 1, base + width, base + width + 1])].astype(np.float64)
    low, high = four.min(0), four.max(0)
    smooth = (low > 0) & (high <= low * (1 + OCCLUSION))
    whole = whole[smooth]
    x, y = (xy[whole] - 0.5 - corner[whole]).T
    inverse = 1 / four[:, smooth]
    upper = inverse[0] * (1 - x) + inverse[1] * x
    lower = inverse[2] * (1 - x) + inverse[3] * x
    out[whole] = 1 / (upper * (1 - y) + lower * y)
    return out


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
