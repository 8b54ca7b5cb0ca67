"""Image and depth metrics of one view: PSNR, SSIM, LPIPS and relative depth error, by region.

Colours are compared in [0, 1] and in float64; the data range is 1. SSIM is that of Z. Wang et al.,
"Image quality assessment: from error visibility to structural similarity", IEEE TIP 13(4), 2004: a
Gaussian window of sigma 1.5 (11 x 11 pixels), population covariances, constants 0.01 and 0.03. A
figure without a pixel to compare is None, never a number.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError
from gvtools.evaluation.statistics import mean_of, median_of

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.scenes.scene import Frame

SIGMA, SIDE = 1.5, 11
K1, K2 = 0.01, 0.03
# Nearer to the border, windows would see pixels that are not there.
SSIM_BORDER = SIDE // 2
INNER = (slice(SSIM_BORDER, -SSIM_BORDER),) * 2
# Colours may lie outside [0, 1], as noise does, but not by more than the data range.
LOWEST, HIGHEST = -1.0, 2.0
SMALLEST = 32  # pixels a side, of a picture that LPIPS can be taken of
# Of each: the whole picture, what stands on observations, what a completer made.
REGIONS = ("", "_valid", "_generated")
FIGURES = (
    *(f"{figure}{region}" for region in REGIONS for figure in ("psnr", "ssim", "lpips")),
    "depth_rel_valid",
    "depth_rel_generated",
)


def psnr(image: ArrayLike, truth: ArrayLike, *, mask: ArrayLike | None = None) -> float | None:
    """Peak signal-to-noise ratio, dB, for a peak of 1, where an (H, W) mask is True.

    Images are (H, W, C) floats in [0, 1], or uint8, which stands for 255 times that. The ratio is
    infinite when the compared pixels are equal, and None when there are none.
    """
    first, second, where = _pair(image, truth, mask)
    if where is not None:
        first, second = first[where], second[where]
    return _decibels((first - second) ** 2)


def ssim(
    image: ArrayLike,
    truth: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    sample_covariance: bool = False,
) -> float | None:
    """Structural similarity, -1 to 1: the mean of the SSIM map over the compared pixels.

    The outermost 5 pixels are never compared, with a mask or without, so that a mask of all pixels
    gives the figure of no mask. Windows at the rim of a mask see pixels outside it. Images and mask
    are as of ``psnr``; sample covariances are scikit-image's default and GLD's, the published
    definition has those of the population.
    """
    first, second, where = _pair(image, truth, mask)
    if min(first.shape[:2]) < SIDE:
        raise ShapeError(
            f"SSIM of {first.shape[1]}x{first.shape[0]} pixels; expected at least {SIDE}x{SIDE}"
        )
    return _mean(ssim_map(first, second, sample_covariance=sample_covariance), where)


def image_figures(
    image: ArrayLike, truth: ArrayLike, regions: Mapping[str, ArrayLike | None]
) -> dict[str, dict[str, float | None]]:
    """PSNR and SSIM over several regions of one image, for little more than the price of one.

    A region is an (H, W) mask as of ``psnr``. The SSIM of an image below 11 x 11 pixels is None.
    """
    first, second, _ = _pair(image, truth, None)
    square = ((first - second) ** 2).mean(axis=-1)
    similarity = ssim_map(first, second) if min(first.shape[:2]) >= SIDE else None
    out = {}
    for name, mask in regions.items():
        where = None if mask is None else np.asarray(mask, np.bool_)
        out[name] = {
            "psnr": _decibels(square if where is None else square[where]),
            "ssim": None if similarity is None else _mean(similarity, where),
        }
    return out


def ssim_map(
    image: NDArray[np.float64], truth: NDArray[np.float64], *, sample_covariance: bool = False
) -> NDArray[np.float64]:
    """SSIM of every whole window of (H, W, C) images in [0, 1], averaged over the channels.

    Of (H - 10, W - 10) entries, (i, j) is centred on pixel (i + 5, j + 5).
    """
    import cv2

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        blurred = cv2.GaussianBlur(values, (SIDE, SIDE), SIGMA).reshape(values.shape)
        return np.asarray(blurred[INNER])

    norm = SIDE**2 / (SIDE**2 - 1) if sample_covariance else 1.0
    x, y = mean(image), mean(truth)
    squares = norm * (mean(image**2 + truth**2) - x**2 - y**2)
    product = norm * (mean(image * truth) - x * y)
    top = (2 * x * y + K1**2) * (2 * product + K2**2)
    return np.asarray((top / ((x**2 + y**2 + K1**2) * (squares + K2**2))).mean(axis=-1))


def relative_depth_error(
    depth: ArrayLike, truth: ArrayLike, *, mask: ArrayLike | None = None
) -> float | None:
    """Median of |depth - truth| / truth over the pixels where both are there; None without any.

    Depth maps are (H, W) z-depth in one unit, 0 = none; the mask is as of ``psnr``.
    """
    first, second = np.asarray(depth, np.float64), np.asarray(truth, np.float64)
    with np.errstate(invalid="ignore"):
        both = (first > 0) & (second > 0) & np.isfinite(first) & np.isfinite(second)
    if mask is not None:
        both &= np.asarray(mask, np.bool_)
    return median_of(np.abs(first[both] - second[both]) / second[both])


def view_figures(
    picture: NDArray[Any],
    truth: Frame,
    *,
    observed: NDArray[np.bool_],
    generated: NDArray[np.bool_],
    others: Mapping[str, NDArray[np.bool_]] | None = None,
    depth: ArrayLike | None = None,
    lpips: Lpips | None = None,
) -> dict[str, float | None]:
    """FIGURES of one picture, and those of ``others``; None where there is nothing to compare.

    The picture is uint8, or floats in [0, 1]; holes are black, and count so on the whole picture.
    The truth's mask limits every comparison. Regions are (H, W) bool: ``observed`` stands on
    observations, ``generated`` a completer made, and figures of ``others`` end in ``_NAME``. Depth
    is z-depth, scene units, 0 = none. LPIPS of a region is the mean of the distance's map, which
    has no meaning for regions much smaller than the network's view; pictures below 32 x 32 pixels
    have none.
    """
    use = np.ones(picture.shape[:2], np.bool_) if truth.mask is None else truth.mask
    regions = {"": use, "_valid": observed & use, "_generated": generated & ~observed & use}
    regions |= {f"_{name}": mask & use for name, mask in (others or {}).items()}
    out: dict[str, float | None] = dict.fromkeys(FIGURES)
    for region, figures in image_figures(picture, truth.rgb, regions).items():
        out |= {f"{name}{region}": value for name, value in figures.items()}
    if lpips is not None and min(use.shape) >= SMALLEST:
        if picture.dtype != np.uint8:
            picture = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
        whole, spread = lpips.distance(picture, truth.rgb)
        for region, mask in regions.items():
            out[f"lpips{region}"] = float(spread[mask].mean()) if mask.any() else None
        if use.all():
            out["lpips"] = whole
    if depth is not None and truth.depth is not None:
        for region in ("_valid", "_generated"):
            error = relative_depth_error(depth, truth.depth, mask=regions[region])
            out[f"depth_rel{region}"] = error
    return out


def _mean(similarity: NDArray[np.float64], where: NDArray[np.bool_] | None) -> float | None:
    """Mean of an SSIM map over a mask of the whole image."""
    return mean_of(similarity if where is None else similarity[where[INNER]])


def _decibels(squares: NDArray[np.float64]) -> float | None:
    error = mean_of(squares)
    if not error:
        return None if error is None else float("inf")
    return float(-10 * np.log10(error))


def _pair(
    image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_] | None]:
    first, second = _unit(image), _unit(truth)
    if first.ndim != 3 or first.shape != second.shape:
        raise ShapeError(f"images of {first.shape} and {second.shape}; expected equal (H, W, C)")
    return first, second, None if mask is None else np.asarray(mask, np.bool_)


def _unit(image: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(image)
    if array.dtype == np.uint8:
        return array / 255.0
    if not np.issubdtype(array.dtype, np.floating):
        raise ShapeError(f"an image of {array.dtype}; expected uint8 or floats in [0, 1]")
    low, high = (float(array.min()), float(array.max())) if array.size else (0.0, 1.0)
    # NaN fails both.
    if not (low >= LOWEST and high <= HIGHEST):
        raise ShapeError(f"an image of values from {low:g} to {high:g}; expected floats in [0, 1]")
    return array.astype(np.float64)
