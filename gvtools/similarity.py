"""Similarity, rigid and scale fits that say whether they hold: never a silent number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError

Float64 = NDArray[np.float64]

# Points whose second principal spread is below this share of the first lie on a line: the
# rotation about it is not determined.
COLLINEAR = 1e-3
# Spreads below this share of the coordinates' magnitude are rounding, not geometry.
COINCIDENT = 1e-13
# Squares below this share of the spread's are sums of cancelling terms.
ROUNDING = 1e-12
# Fewer inliers of a depth scale are refused, as a share.
MIN_INLIER_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """target ≈ scale · rotation · source + translation.

    The translation is that of the given coordinates; where they are large, ``apply`` is more exact
    than the formula, since it works about the centroids.
    """

    status: str  # "aligned", or "degenerate: ..." with the reason; then every number is NaN
    scale: float  # target units per source unit; 1 when it was not fitted
    rotation: Float64  # (3, 3) float64, determinant 1
    translation: Float64  # (3,) float64, target units
    residuals: Float64  # (N,) float64, distances after alignment, target units
    rmse: float  # root mean square of the residuals, target units
    source_center: Float64  # (3,) float64, centroid of the source
    target_center: Float64  # (3,) float64, centroid of the target
    # whether a reflection would leave less than half of the rmse: no rotation makes one
    # handedness of the other
    mirrored: bool = False

    @property
    def ok(self) -> bool:
        """Whether the numbers hold."""
        return self.status == "aligned"

    def apply(self, points: ArrayLike) -> Float64:
        """Points (..., 3) of the source frame in the target frame."""
        centered = np.asarray(points, np.float64) - self.source_center
        return self.scale * centered @ self.rotation.T + self.target_center


def fit_similarity(
    source: ArrayLike, target: ArrayLike, *, with_scale: bool = True
) -> SimilarityFit:
    """The least-squares similarity between paired points, in closed form.

    Follows S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991; equation numbers are its own. Camera centres on a line (a straight
    dolly) leave the rotation about that line open and are reported as degenerate; so are mirror
    images that several rotations fit alike. The unit of the coordinates changes no digit.

    Args:
        source: (N, 3).
        target: (N, 3), row by row the same points.
        with_scale: False fits a rigid motion.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    paired = source.ndim == 2 and source.shape[1:] == (3,) and source.shape == target.shape
    if not paired or not (np.isfinite(source) & np.isfinite(target)).all():
        raise ShapeError(
            f"similarity: source {source.shape} and target {target.shape}; expected both (N, 3), "
            "without NaN or infinity"
        )
    count = len(source)
    if count < 3:
        return _degenerate(count, f"{count} point pair(s), at least 3 are needed")
    x, x_unit, source_center, x_defect = _center(source)  # (34)
    y, y_unit, target_center, y_defect = _center(target)  # (35)
    if x_defect or y_defect:
        defect = f"{x_defect} source" if x_defect else f"{y_defect} target"
        return _degenerate(count, f"{defect} points")
    variance, size = (float((part**2).sum() / count) for part in (x, y))  # (36)
    covariance = y.T @ x / count  # (38)
    u, d, vt = np.linalg.svd(covariance)
    if d[1] < COLLINEAR**2 * d[0] or d[0] <= ROUNDING * np.sqrt(variance * size):
        return _degenerate(count, "source and target do not correspond in two directions")
    sign = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])  # (39), (43)
    if d[1] + sign[2] * d[2] < COLLINEAR**2 * d[0]:
        return _degenerate(count, "a mirror image, which several rotations fit alike")
    rotation = (u * sign) @ vt  # (40)
    kept = x_unit / y_unit
    scale = float((d * sign).sum() / variance) if with_scale else kept  # (42)
    residuals = np.linalg.norm(y - scale * x @ rotation.T, axis=1)
    square = float(np.mean(residuals**2))
    best = d.sum() / variance if with_scale else kept
    other = size - 2 * best * d.sum() + best**2 * variance  # (33), of the reflection
    mirrored = bool(sign[2] < 0 and other < square / 4 and square > ROUNDING * size)
    scale *= y_unit / x_unit
    translation = target_center - scale * rotation @ source_center  # (41)
    return SimilarityFit(
        "aligned", scale, rotation, translation, residuals * y_unit,
        float(np.sqrt(square)) * y_unit, source_center, target_center, mirrored,
    )  # fmt: skip


def fit_line(source: ArrayLike, target: ArrayLike, *, with_scale: bool) -> SimilarityFit:
    """The fit of ``fit_similarity`` where either lies on a line: what its open turn leaves alone.

    Scale and residuals are the same for every rotation about the line; the rotation is NaN.
    """
    x, y = (np.asarray(points, np.float64) for points in (source, target))
    centers = x.mean(axis=0), y.mean(axis=0)
    x, y = x - centers[0], y - centers[1]
    left, d, right = np.linalg.svd(y.T @ x)
    scale = float(d[0] / (x**2).sum()) if with_scale else 1.0
    along, across = scale * (x @ right[0]), scale * x - scale * np.outer(x @ right[0], right[0])
    aside = y - np.outer(y @ left[:, 0], left[:, 0])
    parts = [y @ left[:, 0] - along, *across.T, *aside.T]
    residuals = np.sqrt((np.square(parts)).sum(axis=0))
    nan = np.full((3, 3), np.nan)
    return SimilarityFit(
        "aligned along a line", scale, nan, nan[0], residuals,
        float(np.sqrt((residuals**2).mean())), *centers,
    )  # fmt: skip


def _center(points: Float64) -> tuple[Float64, float, Float64, str]:
    """Points about their centroid, in a power of two near their extent.

    Returns:
        The points (N, 3), the unit, the centroid in the points' own unit, and what is wrong with
        their spread, see ``_spread_defect``.
    """
    # About the first point, so that large offsets keep their digits.
    center = points[0] + (points - points[0]).mean(axis=0)
    moved = points - center
    unit = 2.0 ** int(np.frexp(np.abs(moved).max())[1])
    magnitude = float(np.abs(points).max()) / unit
    return moved / unit, unit, center, _spread_defect(moved / unit, magnitude)


def _spread_defect(centered: Float64, magnitude: float) -> str:
    """Why points do not determine a rotation: "coincident", "collinear", or ""."""
    spread = np.linalg.svd(centered / np.sqrt(len(centered)), compute_uv=False)
    if spread[0] <= COINCIDENT * magnitude:
        return "coincident"
    return "collinear" if spread[1] < COLLINEAR * spread[0] else ""


def _degenerate(count: int, reason: str) -> SimilarityFit:
    nan = np.full((3, 3), np.nan)
    return SimilarityFit(
        f"degenerate: {reason}", np.nan, nan, nan[0], np.full(count, np.nan), np.nan, nan[0], nan[0]
    )


def align_poses(poses: Float64, target: Float64) -> Float64:
    """The rigid motion T (4, 4) such that ``poses @ T`` are nearest to other poses.

    Its rotation is the mean of those that turn each pose into the other, then centres agree on
    average. So it holds for cameras on a line or in one place, where ``fit_similarity`` does not.

    Args:
        poses: (V, 4, 4) camera from world.
        target: (V, 4, 4) camera from another world.

    >>> other = np.eye(4)
    >>> other[0, 3] = 2
    >>> align_poses(np.eye(4)[None], other[None])[0, 3]
    np.float64(2.0)
    """
    turns = np.einsum("vji,vjk->ik", poses[:, :3, :3], target[:, :3, :3])
    left, _, right = np.linalg.svd(turns)
    motion = np.eye(4)
    motion[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    ours, theirs = (-np.einsum("vji,vj->vi", p[:, :3, :3], p[:, :3, 3]) for p in (poses, target))
    motion[:3, 3] = (ours - theirs @ motion[:3, :3].T).mean(axis=0)
    return motion


@dataclass(frozen=True)
class ScaleFit:
    """reference_depth ≈ scale · depth on the pixels that both know."""

    status: str  # "aligned", or "unsupported: ..." with the reason; then ``scale`` is NaN
    scale: float  # multiply the depth by it
    inliers: int  # pixels whose ratio agrees with the scale
    inlier_share: float  # inliers per support pixel, by weight
    residual: float  # median relative deviation from the scale over the support (0.01 = 1 %)
    support: int  # pixels on which both depths are known

    @property
    def ok(self) -> bool:
        """Whether the scale may be used."""
        return self.status == "aligned"


def align_depth_scale(
    depth: ArrayLike,
    reference_depth: ArrayLike,
    *,
    valid: ArrayLike,
    confidence: ArrayLike | None = None,
    min_support: int = 200,
    max_residual: float = 0.1,
    inlier_band: float = 0.05,
) -> ScaleFit:
    """One robust scale between a depth map and the projected memory's depth.

    Starts at the weighted median of the log ratios and re-weights with a redescending (Tukey)
    kernel whose width follows the spread of the ratios, so that occlusions and wrong pixels do not
    pull. Refused rather than guessed when too little supports it.

    Args:
        depth: (...) z-depth, any unit; not above 0 or not finite = none.
        reference_depth: the same shape, scene units.
        valid: the same shape, bool, the pixels to compare.
        confidence: the same shape, >= 0, weights; None means equal.
        min_support: fewer common pixels are refused.
        max_residual: so is a larger median relative deviation.
        inlier_band: largest relative deviation of an inlier.
    """
    ratio, weight = _log_ratios(depth, reference_depth, valid, confidence=confidence)
    support = len(ratio)
    if support < max(min_support, 1):
        return ScaleFit(
            f"unsupported: {support} common pixels, at least {max(min_support, 1)} are needed",
            np.nan, 0, 0.0, np.nan, support,
        )  # fmt: skip
    weight = weight / weight.sum()
    # A completer that leaves the known pixels alone has a depth equal to the memory's.
    equal = not ratio.any()
    center = 0.0 if equal else _tukey_center(ratio, weight)
    deviation = np.abs(np.expm1(ratio - center))
    inlier = deviation <= inlier_band
    share = float(weight[inlier].sum())
    residual = 0.0 if equal else _weighted_median(deviation, weight)
    reason = ""
    if share < MIN_INLIER_SHARE:
        reason = f"{share:.0%} of the pixels agree within {inlier_band:.0%}, " + (
            f"at least {MIN_INLIER_SHARE:.0%} are needed"
        )
    elif residual > max_residual:
        reason = f"median deviation {residual:.1%}, at most {max_residual:.1%} is accepted"
    return ScaleFit(
        f"unsupported: {reason}" if reason else "aligned",
        np.nan if reason else float(np.exp(center)),
        int(inlier.sum()),
        share,
        residual,
        support,
    )


def _log_ratios(
    depth: ArrayLike, reference_depth: ArrayLike, valid: ArrayLike, *, confidence: ArrayLike | None
) -> tuple[Float64, Float64]:
    """log(reference / depth) of the pixels that both know, and their weights, (N,) each."""
    depth, reference = np.asarray(depth, np.float64), np.asarray(reference_depth, np.float64)
    mask = np.asarray(valid, bool)
    weight = np.ones(depth.shape) if confidence is None else np.asarray(confidence, np.float64)
    with np.errstate(invalid="ignore"):
        mask = mask & np.isfinite(depth) & np.isfinite(reference) & (depth > 0) & (reference > 0)
        mask &= np.isfinite(weight) & (weight > 0)
    return np.log(reference[mask]) - np.log(depth[mask]), weight[mask]


def _tukey_center(values: Float64, weight: Float64) -> float:
    """A robust mean: the weighted median, then Tukey's re-weighting."""
    center = _weighted_median(values, weight)
    for _ in range(20):
        gap = np.abs(values - center)
        # 1.4826 · median is the standard deviation of a normal core; Tukey's 4.685 keeps 95 %
        # of its efficiency. The floor keeps exact data from dividing by zero.
        width = 4.685 * max(1.4826 * _weighted_median(gap, weight), 1e-6)
        kernel = weight * np.clip(1 - (gap / width) ** 2, 0, None) ** 2
        update = float((kernel @ values) / kernel.sum())
        moved, center = abs(update - center), update
        if moved < 1e-9:
            break
    return center


def _weighted_median(values: Float64, weight: Float64) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weight[order])
    middle = np.searchsorted(cumulative, 0.5 * cumulative[-1])
    return float(values[order[min(int(middle), len(values) - 1)]])
