"""Figures on generated pixels alone: what a completer put where nothing was observed.

Figures are kept as sums over a scene, so that any set of scenes, and any resampling of them, is
pooled exactly. Pooled figures are ruled by few large holes, means over views by many small ones;
both are given. Intervals are paired: two methods are compared on the same resampled scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ShapeError

Float32 = NDArray[np.float32]
# Relative depth errors are counted in bins of equal ratio; the median is exact to one of them.
EDGES = np.concatenate(([0.0], np.geomspace(1e-4, 1e2, 600)))
RESAMPLES = 2000
LEVEL = 0.95
# A view with fewer generated pixels has no mean of its own.
FEWEST = 16
# Error of a view whose depth is missing, in the mean over views.
NO_DEPTH = 1.0
FIGURES = ("psnr", "psnr_view", "depth", "depth_view", "distance", "distance_view", "energy")


@dataclass(frozen=True, eq=False)
class GeneratedScore:
    """Sums over the generated pixels of some views.

    Attributes:
        pixels: how many.
        squared: sum of the squared colour error, mean over the channels.
        depth_counts: (len(EDGES),) relative depth errors by bin; no depth counts as infinite, and
            errors below the first edge as that.
        distance: sum of the perceptual distance's map; None where it was not measured.
        energy: sum of the squared gradient of the luminance, of the picture and of the truth.
        views: (V, 3) PSNR, median relative depth error and mean distance of each view; NaN where
            there are too few pixels.
    """

    pixels: float
    squared: float
    depth_counts: NDArray[np.float64]
    distance: float | None
    energy: tuple[float, float]
    views: NDArray[np.float64]


def score(
    rgb: Float32,
    depth: Float32,
    *,
    true_rgb: Float32,
    true_depth: Float32,
    generated: NDArray[np.bool_],
    distance: Float32 | None = None,
) -> GeneratedScore:
    """Score completed views.

    Args:
        rgb: (V, H, W, 3) in [0, 1], observed pixels in place.
        depth: (V, H, W) z-depth; 0 or not finite = none.
        true_rgb: (V, H, W, 3) in [0, 1].
        true_depth: (V, H, W); 0 or not finite = unknown, not compared.
        generated: (V, H, W) which pixels are judged.
        distance: (V, H, W) map of a perceptual distance.

    Raises:
        ShapeError: the shapes differ, or a colour or distance that is judged is not finite.
    """
    if rgb.shape != true_rgb.shape or len({depth.shape, true_depth.shape, generated.shape}) > 1:
        raise ShapeError(
            f"completed {rgb.shape} and {depth.shape}, truth {true_rgb.shape} and "
            f"{true_depth.shape}, judged {generated.shape}; expected equal sizes"
        )
    for name, values in (("completed", rgb), ("true", true_rgb), ("distance", distance)):
        if values is not None and not np.isfinite(values[generated]).all():
            raise ShapeError(
                f"{name}: NaN or infinity among the judged pixels of {generated.shape[0]} view(s); "
                "expected finite values"
            )
    squares = np.square(np.clip(rgb, 0, 1).astype(np.float64) - true_rgb).mean(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.abs(depth.astype(np.float64) / true_depth - 1)
    relative[~((depth > 0) & np.isfinite(depth))] = np.inf
    judged = generated & (true_depth > 0) & np.isfinite(true_depth)
    views = np.full((len(rgb), 3), np.nan)
    for index, where in enumerate(generated):
        if where.sum() < FEWEST:
            continue
        views[index, 0] = -10 * np.log10(max(float(squares[index][where].mean()), 1e-10))
        if judged[index].sum() >= FEWEST:
            views[index, 1] = min(float(np.median(relative[index][judged[index]])), NO_DEPTH)
        if distance is not None:
            views[index, 2] = distance[index][where].mean()
    bins = np.searchsorted(EDGES, relative[judged], side="right") - 1
    return GeneratedScore(
        pixels=float(generated.sum()),
        squared=float(squares[generated].sum()),
        depth_counts=np.bincount(bins, minlength=len(EDGES)).astype(np.float64),
        distance=None if distance is None else float(distance[generated].sum()),
        energy=(gradient_energy(rgb, generated), gradient_energy(true_rgb, generated)),
        views=views,
    )


def gradient_energy(rgb: Float32, where: NDArray[np.bool_]) -> float:
    """Sum of squared luminance differences of neighbours that are both in ``where``.

    Args:
        rgb: (V, H, W, 3) in [0, 1].
        where: (V, H, W).
    """
    grey = np.clip(rgb, 0, 1).astype(np.float64) @ np.array([0.299, 0.587, 0.114])
    total = 0.0
    for axis in (1, 2):
        size = grey.shape[axis]
        first, second = np.arange(size - 1), np.arange(1, size)
        both = np.take(where, first, axis) & np.take(where, second, axis)
        total += float(np.square(np.diff(grey, axis=axis))[both].sum())
    return total


def figures(scores: Sequence[GeneratedScore]) -> dict[str, float | None]:
    """FIGURES by name; None where nothing was measured.

    PSNR in dB, 100 at most; relative depth errors are medians, the pooled one None where most
    pixels have no depth; ``energy`` is the picture's gradient energy as a share of the truth's,
    None for a truth without any.
    """
    if not scores:
        return dict.fromkeys(FIGURES)
    return _figures(_Stacked(scores), np.ones((1, len(scores))))[0]


def paired_interval(
    scores: Sequence[GeneratedScore],
    others: Sequence[GeneratedScore],
    figure: str,
    *,
    seed: int = 0,
) -> tuple[float, float, float]:
    """How much a figure differs from another method's on the same scenes: it, and its interval.

    Args:
        scores: of a method, one a scene.
        others: of the other, the same scenes in the same order.
        figure: one of FIGURES.
        seed: of the resampling.

    Returns:
        The difference, and the ends of the 95 % interval of the percentile bootstrap over scenes;
        NaN where either method has no such figure.

    Raises:
        ShapeError: not as many scenes, or none.
        OptionError: no such figure.
    """
    if len(scores) != len(others) or not scores:
        raise ShapeError(
            f"{len(scores)} scenes against {len(others)}; expected the same, at least one"
        )
    if figure not in FIGURES:
        raise OptionError(f"figure {figure!r}; expected one of {', '.join(FIGURES)}")
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, len(scores), (RESAMPLES, len(scores)))
    counts = np.stack([np.bincount(row, minlength=len(scores)) for row in drawn])
    weights = np.concatenate((np.ones((1, len(scores))), counts)).astype(np.float64)
    both = [_figures(_Stacked(each), weights, only=figure) for each in (scores, others)]
    apart = [
        np.nan if a[figure] is None or b[figure] is None else a[figure] - b[figure]  # type: ignore[operator]
        for a, b in zip(*both, strict=True)
    ]
    if np.isnan(apart[1:]).all():
        return float(apart[0]), float("nan"), float("nan")
    low, high = np.nanquantile(apart[1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(apart[0]), float(low), float(high)


class _Stacked:
    """The sums of several scenes as arrays."""

    def __init__(self, scores: Sequence[GeneratedScore]) -> None:
        self.pixels = np.array([s.pixels for s in scores])
        self.squared = np.array([s.squared for s in scores])
        self.depth = np.stack([s.depth_counts for s in scores])
        missing = [s.distance is None for s in scores]
        self.distance = None if any(missing) else np.array([s.distance for s in scores])
        self.energy = np.array([s.energy for s in scores])
        self.view_sums = np.array([np.nansum(s.views, axis=0) for s in scores])
        self.view_counts = np.array([np.isfinite(s.views).sum(0) for s in scores])


def _figures(
    stacked: _Stacked, weights: NDArray[np.float64], *, only: str | None = None
) -> list[dict[str, float | None]]:
    """Figures for each row of scene weights."""
    pixels = weights @ stacked.pixels
    rows = []
    views = _ratio(weights @ stacked.view_sums, weights @ stacked.view_counts)
    values: dict[str, NDArray[np.float64]] = {
        "psnr": -10 * np.log10(np.maximum(_ratio(weights @ stacked.squared, pixels), 1e-10)),
        "psnr_view": views[:, 0],
        "depth_view": views[:, 1],
        "distance_view": views[:, 2],
        "energy": _ratio(weights @ stacked.energy[:, 0], weights @ stacked.energy[:, 1]),
    }
    if only in (None, "depth"):
        values["depth"] = _medians(weights @ stacked.depth)
    if stacked.distance is not None:
        values["distance"] = _ratio(weights @ stacked.distance, pixels)
    for index in range(len(weights)):
        row: dict[str, float | None] = {}
        for name in FIGURES if only is None else (only,):
            value = values[name][index] if name in values else np.nan
            row[name] = float(value) if np.isfinite(value) else None
        rows.append(row)
    return rows


def _ratio(total: NDArray[np.float64], count: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)


def _medians(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median of each row of bin counts, the middle of its bin (by ratio)."""
    upper = np.append(EDGES[1:], np.inf)
    lower = np.maximum(EDGES, EDGES[1] ** 2 / EDGES[2])
    middle = np.sqrt(lower * upper)
    total = counts.sum(1)
    at = (np.cumsum(counts, axis=1) >= total[:, None] / 2).argmax(1)
    return np.where(total > 0, middle[at], np.nan)
